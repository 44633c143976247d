// Head of the page, table of channels, warnings and events: what is written rather than drawn.

import { UNAVAILABLE, byId, count, keepAt, keepOnly, make, microseconds, quantity, seconds, share, write } from "./format.js";
import { boundText } from "./strips.js";

const STATES = { waiting: ["waiting for a run", "caution"], running: ["running", "good"], ended: ["ended", ""] };
const MOST_WARNINGS = 4;
const MOST_EVENTS = 80;
const VIA = { "shared-memory": "shared memory", emulated: "emulated", record: "record only" };

// Run, state and progress; `elapsed_s` is that of the moment shown.
export function showRun(run, elapsed_s) {
  write(byId("run-name"), run.name ?? "no run yet");
  document.title = `${run.name ?? "waiting"} · hil-runtime live`;
  const [words, tone] = STATES[run.state] ?? [run.state, ""];
  const badge = byId("run-state");
  const ended = run.state === "ended" && run.how ? `ended, ${run.how}` : words;
  write(badge, run.is_playback ? `playback${run.speed === 1 ? "" : ` × ${run.speed}`}, ${ended}` : ended);
  badge.className = `badge ${tone}`;
  write(byId("run-case"), run.case ? `case ${run.case}` : "");
  write(byId("elapsed"), elapsed_s === null ? "–" : seconds(elapsed_s));
  write(byId("duration"), run.state === "waiting" ? "–" : run.duration_s === null ? "no fixed end" : seconds(run.duration_s, run.duration_s % 1 ? 1 : 0));
  const bar = byId("progress");
  const part = run.duration_s ? Math.min(100, (100 * (elapsed_s ?? 0)) / run.duration_s) : 0;
  bar.setAttribute("aria-valuenow", part.toFixed(0));
  bar.firstElementChild.style.width = `${part}%`;
}

export function showFacts(run, channels) {
  const away = run.hosts.filter((host) => !run.hosts_here.includes(host));
  const bounds = (channels?.channels ?? []).filter((channel) => channel.link_state !== "none").map((channel) => channel.clock_bound_us);
  const worst = bounds.length === 0 ? undefined : bounds.includes(null) ? null : Math.max(...bounds);
  const { recorder } = run;
  const facts = [
    ["hosts here", run.hosts_here.join(", ") || UNAVAILABLE],
    ["elsewhere", away.join(", ")],
    ["clock bound", worst === undefined ? "" : boundText(worst)],
    ["topology", run.topology_hash === null ? "" : String(run.topology_hash).slice(0, 12)],
    ["seed", run.seed === null ? "" : String(run.seed)],
    ["recording", recorder.file ?? ""],
    ["read", `${count(recorder.read_count)} messages${recorder.missed_count === null ? "" : `, ${count(recorder.missed_count)} missed`}`],
    ["viewers", count(recorder.viewer_count)],
  ];
  const list = byId("facts");
  const shown = facts.filter(([, value]) => value !== "");
  const key = JSON.stringify(shown);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...shown.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))));
}

export function showWarnings(run) {
  const warnings = [...overran(run.overruns ?? [], run.overrun_hosts ?? [], run.state), ...run.warnings];
  const section = byId("warnings");
  const key = JSON.stringify(warnings);
  if (section.dataset.key === key) return;
  section.dataset.key = key;
  section.hidden = warnings.length === 0;
  const lines = warnings.map((warning) => `${warning.process ? `${warning.process}: ` : ""}${warning.what}`);
  const items = lines.slice(0, MOST_WARNINGS).map((line) => make("li", {}, line));
  if (lines.length > MOST_WARNINGS) items.push(make("li", { class: "faint" }, `and ${lines.length - MOST_WARNINGS} more`));
  section.firstElementChild.replaceChildren(...items);
}

// Ticks that went by without their process, by host: no delay of these is the network's. A host that is not
// heard may have skipped any number by now.
function overran(overruns, hosts, state) {
  const skipped = (host) => overruns.filter((one) => one.host === host && one.skipped_tick_count > 0);
  const words = (host) => {
    const each = skipped(host.host).map((one) => `${one.process} ${count(one.skipped_tick_count)}`);
    if (host.left_out_count > 0) each.push(`${count(host.left_out_count)} more processes`);
    return each.join(", ");
  };
  return hosts.flatMap((host) => {
    const each = words(host);
    if (state !== "ended" && !host.is_heard) {
      const silence = host.silent_s === null ? "not heard yet" : `not heard for ${seconds(host.silent_s, 0)}`;
      return [{ what: `host ${host.host}: ticks skipped ${UNAVAILABLE}, ${silence}${each && `; last told: ${each}`}` }];
    }
    const when = state === "ended" ? "as last told before the end" : "so far";
    return each ? [{ what: `host ${host.host} overran, ticks skipped ${when}: ${each}` }] : [];
  });
}

// One row per channel; cells are kept and rewritten, so that focus and selection stay.
export class ChannelTable {
  constructor(table, choose) {
    Object.assign(this, { body: table.tBodies[0], choose, rows: new Map() });
  }

  show(channels, run, chosen) {
    const described = new Map((run?.channels ?? []).map((channel) => [channel.name, channel]));
    const present = new Set(channels.map((channel) => channel.name));
    keepOnly(this.rows, present);
    for (const [index, channel] of channels.entries()) {
      if (!this.rows.has(channel.name)) this.rows.set(channel.name, this.row(channel.name));
      const { item, cells } = this.rows.get(channel.name);
      keepAt(this.body, index, item);
      item.classList.toggle("chosen", channel.name === chosen);
      const texts = figuresOf(channel, described.get(channel.name));
      for (const [name, text] of Object.entries(texts)) {
        write(cells[name], text);
        cells[name].classList.toggle("unknown", text === UNAVAILABLE);
      }
      cells.lost.classList.toggle("some", channel.window_lost_count > 0);
      cells.link.classList.toggle("some", channel.link_state === "silent");
    }
  }

  row(name) {
    const button = make("button", { type: "button" }, name);
    button.addEventListener("click", () => this.choose(name));
    const item = make("tr", { "data-channel": name }, make("th", { scope: "row" }, button));
    const cells = {};
    for (const label of ["way", "link", "rate", "published", "taken", "lost", "share lost", "p50", "p99", "max", "clock bound"]) {
      const isText = label === "way" || label === "link";
      cells[label] = make("td", { "data-label": label, class: isText ? undefined : "n" });
      item.append(cells[label]);
    }
    return { item, cells };
  }
}

function figuresOf(channel, described) {
  const isKnown = described && (described.from !== null || described.to !== null);
  const way = isKnown ? `${described.from ?? "nobody"} → ${described.to ?? "record"}` : UNAVAILABLE;
  const kind = described ? VIA[described.via] ?? described.via.toUpperCase() : "";
  const link = described?.link ? `${described.link}, ${kind}` : kind;
  const silent = channel.link_state !== "silent" ? "" : channel.silent_s === null ? ", silent" : `, silent for ${seconds(channel.silent_s)}`;
  const crosses = described ? described.via !== "shared-memory" && described.via !== "record" : channel.lost_count !== null;
  const time = (name) => (channel.one_way === null ? UNAVAILABLE : channel.one_way[name] === null ? "–" : microseconds(channel.one_way[name]));
  return {
    way,
    link: `${link}${silent}`,
    rate: quantity(channel.rate_hz, "Hz"),
    published: count(channel.published_count),
    taken: count(channel.taken_count),
    lost: crosses ? count(channel.lost_count) : "no link",
    "share lost": crosses ? share(channel.lost_count, channel.published_count) : "–",
    p50: time("p50_us"),
    p99: time("p99_us"),
    max: time("max_us"),
    "clock bound": boundText(channel.clock_bound_us),
  };
}

// What happened to the arms: sessions that ended, and arms that began to hold for want of commands.
export function armEvents(pictures) {
  const found = [];
  const before = new Map();
  for (const { value } of pictures) {
    for (const arm of value.arms) {
      const last = before.get(arm.side);
      const isHolding = arm.flags.includes("holding");
      if (last?.state === "running" && arm.state !== null && arm.state !== "running") {
        found.push({ at_s: value.at_s, tone: "bad", words: `${arm.side} arm: session ${last.session} ended, ${arm.state}` });
      } else if (last && isHolding && !last.isHolding) {
        found.push({ at_s: value.at_s, tone: "caution", words: `${arm.side} arm holds, no command` });
      }
      before.set(arm.side, { state: arm.state, session: arm.session, isHolding });
    }
  }
  return found;
}

// What was lost and what happened to the robots up to the moment shown, the newest first.
export function showEvents(losses, collisions, ofArms) {
  const list = byId("event-list");
  const rows = [
    ...losses.slice(-MOST_EVENTS).map((loss) => ({ at_s: loss.at_s, tone: "caution", words: lossWords(loss) })),
    ...collisions.map((hit) => ({ at_s: hit.at_s, tone: "bad", words: collisionWords(hit) })),
    ...ofArms,
  ];
  rows.sort((one, other) => other.at_s - one.at_s);
  const shown = rows.slice(0, MOST_EVENTS);
  const key = shown.length === 0 ? "none" : JSON.stringify([shown.length, shown[0], shown.at(-1)]);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...shown.map((row) => make("li", { class: row.tone }, make("time", {}, seconds(row.at_s, 2)), make("span", {}, row.words))));
  write(byId("events-note"), shown.length === 0 ? "nothing lost, nothing happened to a robot since this page was opened" : rows.length > shown.length ? `the last ${shown.length}` : "");
}

function lossWords(loss) {
  const { sequences } = loss;
  const numbers = sequences.length === 0 ? "" : sequences.length === 1 ? ` no. ${sequences[0]}`
    : ` nos. ${sequences.slice(0, 6).join(", ")}${loss.count > 6 ? " …" : ""}`;
  return `${loss.channel}: ${loss.count === 1 ? "1 message" : `${count(loss.count)} messages`} lost,${numbers}`;
}

function collisionWords(hit) {
  const basis = hit.basis === "states" ? ", by the last reported states" : "";
  return `collision of robots ${hit.robots.join(" and ")} of fleet ${hit.fleet} at ${quantity(hit.x_m, "m", 1)}, ${quantity(hit.y_m, "m", 1)} (${hit.kind})${basis}`;
}
