// Strip charts of delays: one strip per segment of a channel, or per channel, over the last stretch of time.

import { FONT, UNAVAILABLE, keepAt, keepOnly, make, microseconds, polyline, stroked, surface, write } from "./format.js";

const WHOLE = "published to taken";
const LEFT_PX = 58;
const SMALLEST_US = 1;
const SHORTEST_S = 10;

export class Strips {
  constructor(list, choice) {
    Object.assign(this, { list, choice, strips: new Map(), names: "", isLog: true, span_s: 60, drawn_s: SHORTEST_S });
  }

  // The channels to choose from; "" is all of them at once.
  offer(names) {
    const key = names.join("\n");
    if (key === this.names) return;
    this.names = key;
    const chosen = this.choice.value;
    this.choice.replaceChildren(make("option", { value: "" }, "all channels"), ...names.map((name) => make("option", { value: name }, name)));
    this.choice.value = names.includes(chosen) ? chosen : "";
  }

  choose(name) {
    this.choice.value = name;
  }

  // What each strip draws: a label, the channel, and how to find its figures in a channel's entry.
  wanted(newest) {
    const channels = newest.channels;
    const chosen = channels.find((channel) => channel.name === this.choice.value);
    const whole = (channel, label) => ({ label, channel: channel.name, unknown: channel.taken_count === null ? "nobody takes it on this host" : "its ends have no common clock",
      take: (entry) => entry.one_way });
    // What only the record keeps has no time to draw; chosen by name, it says so.
    const isTaken = (channel) => channel.one_way !== null || channel.taken_count !== null || channel.link_state !== "none";
    if (!chosen) return channels.filter(isTaken).map((channel) => whole(channel, channel.name));
    const segments = chosen.segments.map((segment) => ({
      label: segment.name.replace(/-(?=[a-zA-Z])/, " → "), channel: chosen.name,
      unknown: "this host has no such stage",
      take: (entry) => entry.segments.find((one) => one.name === segment.name && one.is_available),
    }));
    const isOne = chosen.segments.length === 1 && chosen.segments[0].name === "published-taken";
    return isOne ? segments : [whole(chosen, WHOLE), ...segments];
  }

  // The stretch drawn: what was chosen, or what there is yet.
  stretch(kept_s) {
    this.drawn_s = Math.min(this.span_s, Math.max(kept_s, SHORTEST_S));
    return this.drawn_s;
  }

  draw(samples, losses, moment, colours) {
    const newest = samples.at(-1)?.value;
    if (!newest) return;
    const wanted = this.wanted(newest);
    const present = new Set();
    this.list.style.setProperty("--strip", `${this.stripHeight(wanted.length)}px`);
    for (const [index, one] of wanted.entries()) {
      const key = `${one.channel}\n${one.label}`;
      present.add(key);
      if (!this.strips.has(key)) this.strips.set(key, this.strip(one));
      keepAt(this.list, index, this.strips.get(key).item);
      this.drawOne(this.strips.get(key), one, samples, losses, moment, colours);
    }
    keepOnly(this.strips, present);
  }

  // Few strips are drawn large; of many, each stays high enough to be read. Those without a figure take
  // no room.
  stripHeight(wanted) {
    const drawn = [...this.strips.values()].filter((strip) => !strip.item.classList.contains("off")).length || wanted;
    return drawn > 9 ? 48 : drawn > 3 ? 60 : 84;
  }

  strip(one) {
    const values = make("output", { "data-strip": `${one.channel} ${one.label}` });
    const canvas = make("canvas", { role: "img" });
    const label = make("div", { class: "label" }, make("span", {}, one.label), values);
    const item = make("li", { class: "strip" }, label, make("div", { class: "plot" }, canvas));
    this.list.append(item);
    return { item, values, canvas };
  }

  drawOne(strip, one, samples, losses, moment, colours) {
    const isIt = (channel) => channel?.name === one.channel;
    const place = samples.at(-1).value.channels.findIndex(isIt);
    const entryOf = ({ value: { channels } }) => (isIt(channels[place]) ? channels[place] : channels.find(isIt));
    const points = samples.map((sample) => {
      const entry = entryOf(sample);
      return { time: sample.time, entry, figures: entry && one.take(entry) };
    });
    const last = points.at(-1).figures;
    // Nothing to draw: nobody can tell, or nothing came and nothing is missed.
    const isUnknown = !points.some((point) => point.figures);
    const hasFigures = points.some((point) => point.figures?.p50_us != null);
    const isEmpty = !hasFigures && !losses.some((loss) => loss.channel === one.channel) && !points.some((point) => point.entry?.link_state === "silent");
    strip.item.classList.toggle("off", isEmpty);
    const words = isUnknown ? `${UNAVAILABLE}: ${one.unknown}` : isEmpty ? `no message in the last ${Math.round(this.drawn_s)} s` : last?.p50_us === null || !last ? "no message in the last second"
      : `p50 ${microseconds(last.p50_us)} · p99 ${microseconds(last.p99_us)} · max ${microseconds(last.max_us)}`;
    write(strip.values, words);
    strip.values.dataset.points = points.filter((point) => point.figures?.p50_us != null).length;
    if (isEmpty) return;
    strip.canvas.setAttribute("aria-label", `${one.channel}, ${one.label}, last ${Math.round(this.drawn_s)} s: ${words}`);
    const ticks = losses.filter((loss) => loss.channel === one.channel);
    this.paint(strip.canvas, points, ticks, moment, colours);
  }

  paint(canvas, points, ticks, moment, colours) {
    const { context, width, height } = surface(canvas);
    const from = moment - this.drawn_s;
    const x = (time) => LEFT_PX + ((time - from) / this.drawn_s) * (width - LEFT_PX - 2);
    const scale = this.isLog ? logScale(points, height) : linearScale(points, height);
    this.grid(context, scale, x, width, height, from, colours);
    this.silences(context, points, x, height, colours);
    context.save();
    context.beginPath();
    context.rect(LEFT_PX, 0, width - LEFT_PX, height);
    context.clip();
    for (const whole of pieces(points)) {
      const piece = thinned(whole, this.drawn_s / (width - LEFT_PX));
      context.fillStyle = context.strokeStyle = colours.series[0];
      context.globalAlpha = 0.22;
      const curve = (figure) => piece.map((point) => [x(point.time), scale.y(point.figures[figure])]);
      polyline(context, [...curve("p99_us"), ...curve("p50_us").reverse()]);
      context.fill();
      context.globalAlpha = 1;
      context.lineWidth = 1.6;
      context.lineJoin = "round";
      polyline(context, curve("p50_us"));
      if (piece.length === 1) context.lineTo(x(piece[0].time) + 1.5, scale.y(piece[0].figures.p50_us));
      context.stroke();
    }
    context.fillStyle = colours.bad;
    for (const tick of ticks) context.fillRect(x(tick.time) - 0.6, height - 8, 1.2, 8);
    context.restore();
  }

  grid(context, scale, x, width, height, from, colours) {
    context.font = `11px ${FONT}`;
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const { value, y } of scale.ticks) {
      stroked(context, [[LEFT_PX, y], [width, y]], colours.rule, 1);
      context.fillStyle = colours.faint;
      context.fillText(value === 0 ? "0" : microseconds(value).replace(/\.0+ /, " "), LEFT_PX - 6, Math.min(Math.max(y, 7), height - 7));
    }
    const step = this.drawn_s / 6;
    for (let number = 1; number < 6; number += 1) {
      const at = x(from + number * step);
      stroked(context, [[at, 0], [at, height]], colours.rule, 1);
    }
  }

  silences(context, points, x, height, colours) {
    context.fillStyle = colours.bad;
    context.globalAlpha = 0.12;
    points.forEach((point, index) => {
      if (point.entry?.link_state !== "silent") return;
      const left = Math.max(x(point.time), LEFT_PX);
      const right = x(points[index + 1]?.time ?? point.time + 0.1);
      if (right > left) context.fillRect(left, 0, right - left, height);
    });
    context.globalAlpha = 1;
  }
}

const GAP_S = 1.5;

// Stretches without a gap: the line breaks where nothing was measured.
function pieces(points) {
  const found = [];
  let piece = [];
  for (const point of points) {
    const isKnown = point.figures && point.figures.p50_us !== null && point.figures.p99_us !== null;
    const follows = piece.length === 0 || point.time - piece.at(-1).time < GAP_S;
    if (piece.length > 0 && (!isKnown || !follows)) {
      found.push(piece);
      piece = [];
    }
    if (isKnown) piece.push(point);
  }
  if (piece.length > 0) found.push(piece);
  return found;
}

// Where several points share a pixel: the lowest and the highest p50 of them, and the highest p99.
function thinned(points, pixel_s) {
  if (points.length < 2 || points[1].time - points[0].time > pixel_s / 2) return points;
  const kept = [];
  let group = [];
  const close = () => {
    if (group.length === 0) return;
    const p50s = group.map((point) => point.figures.p50_us);
    const p99_us = Math.max(...group.map((point) => point.figures.p99_us));
    const ends = [Math.min(...p50s), Math.max(...p50s)];
    if (group[0].figures.p50_us > group.at(-1).figures.p50_us) ends.reverse();
    for (const p50_us of ends) kept.push({ time: group[0].time, figures: { p50_us, p99_us } });
    group = [];
  };
  for (const point of points) {
    // Columns of the axis, not of the window, so that a curve does not flicker while it moves.
    const column = Math.floor(point.time / pixel_s);
    if (group.length > 0 && column !== Math.floor(group[0].time / pixel_s)) close();
    group.push(point);
  }
  close();
  return kept;
}

function extremes(points) {
  let [low, high] = [Infinity, -Infinity];
  for (const { figures } of points) {
    if (!figures || figures.p50_us === null) continue;
    low = Math.min(low, figures.p50_us);
    high = Math.max(high, figures.p99_us ?? figures.p50_us);
  }
  return high < low ? [SMALLEST_US, 1000] : [low, high];
}

function logScale(points, height) {
  const [low, high] = extremes(points).map((value) => Math.max(value, 0.01));
  const bottom = Math.floor(Math.log10(low) + 1e-9);
  const top = Math.max(Math.ceil(Math.log10(high) - 1e-9), bottom + 1);
  const y = (value) => height - 4 - ((Math.log10(Math.max(value, 0.01)) - bottom) / (top - bottom)) * (height - 8);
  const every = Math.ceil((top - bottom) / Math.max(1, Math.floor(height / 22)));
  const ticks = [];
  for (let power = bottom; power <= top; power += every) ticks.push({ value: 10 ** power, y: y(10 ** power) });
  return { y, ticks };
}

function linearScale(points, height) {
  const [, high] = extremes(points);
  const decade = 10 ** Math.floor(Math.log10(Math.max(high, 0.01)));
  const top = [1, 2, 5, 10].map((step) => step * decade).find((step) => step >= high * 0.999);
  const y = (value) => height - 4 - (Math.max(value, 0) / top) * (height - 8);
  return { y, ticks: [0, top / 2, top].map((value) => ({ value, y: y(value) })) };
}

export function boundText(bound_us) {
  if (bound_us === 0) return "0, one clock";
  return bound_us === null || bound_us === undefined ? UNAVAILABLE : `± ${microseconds(bound_us)}`;
}

