// Conditions of emulated links: controls that ask the server, and show what the server confirmed.

import { make, write } from "./format.js";

const CONTROLS = {
  delay_ms: { label: "delay", unit: "ms", shown: 1, most: 500, step: 1, limit: 60000 },
  loss_ratio: { label: "loss", unit: "%", shown: 100, most: 100, step: 0.5, limit: 100 },
  is_cut: { label: "cut" },
};
const SETTLE_MS = 150;
const ANSWER_MS = 3000;

export class Conditions {
  constructor(list, none, send) {
    Object.assign(this, { list, none, send, controls: new Map(), confirmed: new Map(), key: "", nextId: 1 });
  }

  // The links of the run. Those of shared memory or a real wire have no condition to set.
  offer(links) {
    const key = JSON.stringify(links.map((link) => [link.name, link.directions.map((way) => [way.way, way.is_settable, way.why_not])]));
    if (key !== this.key) this.build(links, key);
    for (const link of links) {
      for (const way of link.directions) {
        for (const [name, value] of Object.entries(way.condition ?? {})) this.confirm(parameterName(link, way, name), value);
      }
    }
  }

  build(links, key) {
    this.key = key;
    this.controls.clear();
    const ways = links.filter((link) => link.via === "emulated").flatMap((link) => link.directions.map((way) => [link, way]));
    const settable = ways.filter(([, way]) => way.is_settable);
    this.none.hidden = ways.length > 0;
    this.list.replaceChildren(...settable.map(([link, way]) => this.group(link, way)), ...fixed(ways.filter(([, way]) => !way.is_settable)));
    for (const [name, value] of this.confirmed) this.show(name, value);
  }

  group(link, way) {
    const title = titleOf(link, way);
    const rows = Object.keys(CONTROLS).map((name) => this.control(parameterName(link, way, name), name, title));
    return make("fieldset", { "data-link": `${link.name}.${way.way}` }, make("legend", {}, title), ...rows);
  }

  control(parameter, name, title) {
    const kind = CONTROLS[name];
    const state = make("output", { "data-parameter": parameter }, "not told");
    const described = `${kind.label} of ${title}`;
    if (name === "is_cut") return this.cutControl(parameter, kind, described, state);
    const [most, step] = [kind.most, kind.step];
    const slide = make("input", { type: "range", min: 0, max: most, step, value: 0, "aria-label": `${described}, ${kind.unit}` });
    const typed = make("input", { type: "number", min: 0, max: kind.limit, step: "any", value: "", "aria-label": `${described}, ${kind.unit}`, id: `set-${parameter}` });
    const ask = (text) => {
      const shown = Number(text);
      if (text === "" || !Number.isFinite(shown) || shown < 0 || shown > kind.limit) {
        return this.tell(state, "bad", `must be 0 to ${kind.limit} ${kind.unit}`);
      }
      slide.value = typed.value = text;
      return this.askSoon(parameter, { name: parameter, type: "float64", value: shown / kind.shown });
    };
    slide.addEventListener("input", () => ask(slide.value));
    typed.addEventListener("change", () => ask(typed.value));
    this.controls.set(parameter, { kind, state, slide, typed });
    return make("div", { class: "control" }, make("span", {}, kind.label), slide, make("span", { class: "typed" }, typed, kind.unit), state);
  }

  cutControl(parameter, kind, described, state) {
    const box = make("input", { type: "checkbox", "aria-label": described, id: `set-${parameter}` });
    box.addEventListener("change", () => this.askSoon(parameter, { name: parameter, value: box.checked }));
    this.controls.set(parameter, { kind, state, box });
    return make("div", { class: "control" }, make("span", {}, kind.label), make("label", { class: "cut" }, box, "nothing gets through"), state);
  }

  // A slider that is being drawn asks at most every few moments, with its last value.
  askSoon(parameter, request) {
    const control = this.controls.get(parameter);
    clearTimeout(control.timer);
    clearTimeout(control.late);
    this.tell(control.state, "", "asking…");
    control.asked = request.value;
    control.timer = setTimeout(() => {
      control.timer = undefined;
      const isSent = this.send(request, `set-${this.nextId++}`);
      if (!isSent) return this.tell(control.state, "bad", "not connected");
      control.late = setTimeout(() => this.unanswered(parameter, control), ANSWER_MS);
      return undefined;
    }, SETTLE_MS);
  }

  unanswered(parameter, control) {
    if (control.asked === undefined) return;
    control.asked = undefined;
    this.tell(control.state, "bad", "not confirmed");
    if (this.confirmed.has(parameter)) this.show(parameter, this.confirmed.get(parameter), "not confirmed; still ");
  }

  // What the server says a parameter is. Only this counts as set.
  confirm(parameter, value) {
    if (value === null || value === undefined) return;
    this.confirmed.set(parameter, value);
    this.show(parameter, value);
  }

  show(parameter, value, before = "") {
    const control = this.controls.get(parameter);
    if (!control || control.timer !== undefined) return;
    if (control.asked !== undefined && !equal(control.asked, value)) return;
    const wasAsked = control.asked !== undefined;
    if (wasAsked) clearTimeout(control.late);
    control.asked = undefined;
    if (control.box) {
      control.box.checked = value === true;
      this.tell(control.state, before ? "bad" : "good", `${before}${value ? "cut" : "open"}${before ? "" : ", confirmed"}`);
      return;
    }
    const shown = Number((value * control.kind.shown).toPrecision(6));
    if (document.activeElement !== control.typed || wasAsked) control.typed.value = shown;
    control.slide.max = Math.max(control.kind.most, Math.min(shown, control.kind.limit));
    control.slide.value = shown;
    this.tell(control.state, before ? "bad" : "good", `${before}${shown} ${control.kind.unit}${before ? "" : ", confirmed"}`);
  }

  tell(state, tone, words) {
    state.className = tone;
    write(state, words);
  }

  // After a lost connection nothing is confirmed until the server says so again.
  forget() {
    for (const control of this.controls.values()) this.tell(control.state, "", "not told");
    this.confirmed.clear();
  }
}

const titleOf = (link, way) => {
  const [from, to] = way.way === "backward" ? [link.to_host, link.from_host] : [link.from_host, link.to_host];
  return `${link.name}, ${from ?? "?"} → ${to ?? "?"}`;
};

// What cannot be changed from here needs no controls: a line for each reason, with the ways it holds for.
function fixed(ways) {
  const reasons = new Map();
  for (const [link, way] of ways) {
    const why = way.why_not ?? "the server does not say why";
    reasons.set(why, [...(reasons.get(why) ?? []), titleOf(link, way)]);
  }
  return [...reasons].map(([why, titles]) => make("p", { class: "faint", "data-fixed": titles.length }, `Not to be changed here: ${titles.join("; ")} (${why})`));
}

const parameterName = (link, way, name) => `link.${link.name}.${way.way}.${name}`;

const equal = (one, other) => (typeof one === "number" ? Math.abs(one - other) < 1e-6 : one === other);
