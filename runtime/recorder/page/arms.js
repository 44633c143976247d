// The robot's arms in space: measured solid, commanded as an outline; own projection, far parts first.

import { FONT, age, chipOf, isEmpty, legendEntry, make, quantity, stroked, surface, write } from "./format.js";

const START = { turn: -0.62, tilt: 0.36, zoom: 1 };
const CENTRE = [0.2, 0, 0.26];
const DISTANCE_M = 2.6;
const FLOOR_M = { x: [-0.2, 0.6], y: [-0.5, 0.5], step: 0.1 };
const TRAIL_S = 2;
const NEAR_M = 0.2;

export class ArmScene {
  constructor(canvas, list) {
    Object.assign(this, { canvas, list_: list, chips: new Map(), tools: [], ...START });
  }

  legend() {
    return [legendEntry("solid", "measured"), legendEntry("ghost", "commanded"), make("li", {}, "drag to turn, Ctrl and wheel or + and − to zoom")];
  }

  drag(dx, dy) {
    this.turn -= dx * 0.008;
    this.tilt = Math.min(Math.max(this.tilt + dy * 0.006, -0.15), 1.5);
  }

  zoomBy(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.5), 6);
  }

  reset() {
    Object.assign(this, START);
  }

  // Body coordinates to pixels and depth; undefined behind the eye.
  project([x, y, z]) {
    const [dx, dy, dz] = [x - CENTRE[0], y - CENTRE[1], z - CENTRE[2]];
    const [c, s] = [Math.cos(this.turn), Math.sin(this.turn)];
    const right = -s * dx + c * dy;
    const away = -(c * dx + s * dy);
    const up = Math.cos(this.tilt) * dz + Math.sin(this.tilt) * away;
    const depth = DISTANCE_M + Math.cos(this.tilt) * away - Math.sin(this.tilt) * dz;
    if (depth < NEAR_M) return undefined;
    const scale = (this.size * this.zoom) / depth;
    return { x: this.middle[0] + right * scale, y: this.middle[1] - up * scale, depth, scale };
  }

  draw(arms, colours, trails) {
    const { context, width, height } = surface(this.canvas);
    this.colours = colours;
    this.size = Math.min(height * 2.3, width * 2.2);
    this.middle = [width / 2, height * 0.47];
    this.tools = [];
    if (isEmpty(this.canvas)) return;
    this.floor(context);
    if (!arms) return;
    const parts = [...this.bodyParts(arms)];
    for (const arm of arms.arms) parts.push(...this.armParts(arm.measured_frames, arms, this.colourOf(arm)));
    parts.sort((one, other) => other.depth - one.depth);
    for (const part of parts) paint(context, part, colours);
    this.ghost(context, arms, width, height);
    for (const arm of arms.arms) this.tool(context, arm, trails?.[arm.side]);
    this.axes(context, height);
    this.list(arms);
  }

  colourOf(arm) {
    return arm.side === "left" ? this.colours.series[2] : this.colours.series[0];
  }

  floor(context) {
    const line = (from, to) => {
      const [a, b] = [this.project(from), this.project(to)];
      if (a && b) stroked(context, [[a.x, a.y], [b.x, b.y]], this.colours.rule, 1);
    };
    const { x, y, step } = FLOOR_M;
    for (let at = x[0]; at <= x[1] + 1e-9; at += step) line([at, y[0], 0], [at, y[1], 0]);
    for (let at = y[0]; at <= y[1] + 1e-9; at += step) line([x[0], at, 0], [x[1], at, 0]);
  }

  // What the robot's description says carries the arms.
  bodyParts(arms) {
    const { body } = arms;
    return body.map((rod) => this.rod(rod.from_m, rod.to_m, rod.radius_m, this.colours.faint)).filter(Boolean);
  }

  // What it says of an arm: links between its frames, and fingers in the last.
  armParts(frames, { shapes, fingers }, colour) {
    if (!frames) return [];
    const links = shapes.map((shape) => this.rod(frames[shape.from], frames[shape.to], shape.radius_m, colour));
    const tool = frames.at(-1);
    const within = (place) => rotate(tool, place).map((value, axis) => tool[axis] + value);
    const ends = fingers.map((rod) => this.rod(within(rod.from_m), within(rod.to_m), rod.radius_m, colour));
    return [...links, ...ends].filter(Boolean);
  }

  // A rod with round ends as the screen has it; undefined when it is behind the eye.
  rod(from, to, radius, colour) {
    const [a, b] = [from && this.project(from), to && this.project(to)];
    if (!a || !b) return undefined;
    return { a, b, colour, width: Math.max(radius * (a.scale + b.scale), 2), depth: (a.depth + b.depth) / 2 };
  }

  // What was commanded, as the outline of the whole arm: drawn thick, then hollowed out.
  ghost(context, arms, width, height) {
    const layer = (this.layer ??= document.createElement("canvas"));
    layer.width = this.canvas.width;
    layer.height = this.canvas.height;
    const pen = layer.getContext("2d");
    const ratio = layer.width / width;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineCap = "round";
    const colour = this.colours.series[1];
    const rods = arms.arms.flatMap((arm) => this.armParts(arm.desired_frames, arms, colour));
    for (const rod of rods) stroke(pen, rod, colour, rod.width + 1.6, 1);
    pen.globalCompositeOperation = "destination-out";
    for (const rod of rods) stroke(pen, rod, "#000", Math.max(rod.width - 1.6, 0.5), 1);
    pen.globalCompositeOperation = "destination-over";
    for (const rod of rods) stroke(pen, rod, colour, rod.width, 0.05);
    pen.globalCompositeOperation = "source-over";
    context.drawImage(layer, 0, 0, width, height);
  }

  tool(context, arm, trail) {
    const draw = (points, style, width) => stroked(context, points.map(({ x, y }) => [x, y]), style, width);
    const seen = (points) => points.map((point) => this.project(point)).filter(Boolean);
    if (trail?.length > 1) {
      context.globalAlpha = 0.7;
      draw(seen(trail), this.colourOf(arm), 1.4);
      context.globalAlpha = 1;
    }
    const [is, wanted] = [arm.measured_frames?.at(-1), arm.desired_frames?.at(-1)].map((frame) => frame && this.project(frame));
    if (is && wanted) draw([is, wanted], this.colours.bad, 2.4);
    if (is) this.tools.push({ side: arm.side, x_px: is.x, y_px: is.y, arm });
  }

  // Which way is forward: the robot's axes in a corner, turned as the scene is.
  axes(context, height) {
    const origin = this.project(CENTRE);
    const corner = [42, height - 34];
    const names = [["x", this.colours.series[1]], ["y", this.colours.series[2]], ["z", this.colours.series[0]]];
    context.font = `600 12px ${FONT}`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    names.forEach(([name, colour], axis) => {
      const end = this.project(CENTRE.map((value, index) => value + (index === axis ? 0.1 : 0)));
      const unit = 24 / (0.1 * origin.scale);
      const [dx, dy] = [(end.x - origin.x) * unit, (end.y - origin.y) * unit];
      context.fillStyle = colour;
      stroked(context, [corner, [corner[0] + dx, corner[1] + dy]], colour, 2);
      context.fillText(name, corner[0] + dx * 1.45, corner[1] + dy * 1.45);
    });
  }

  list(arms) {
    for (const arm of arms.arms) {
      if (!this.chips.has(arm.side)) this.chips.set(arm.side, chipOf(this.list_, arm.side, { "data-arm": arm.side }, "whole"));
      const { mark, text, item } = this.chips.get(arm.side);
      mark.style.background = this.colourOf(arm);
      const session = arm.session === null ? arm.state ?? "no session" : `${arm.state ?? "unknown"}, session ${arm.session}`;
      const flags = arm.flags.length > 0 ? ` · ${arm.flags.join(", ")}` : "";
      write(text, `tool error ${quantity(arm.tool_error_mm, "mm", 1)} · ${session} · last heard ${age(arm.measured_age_s)} ago${flags}`);
      item.classList.toggle("stale", arm.measured_age_s === null || arm.measured_age_s > 1);
      const tool = this.tools.find((one) => one.side === arm.side);
      if (tool) Object.assign(text.dataset, { x: tool.x_px.toFixed(1), y: tool.y_px.toFixed(1) });
    }
  }

  describe(x, y) {
    const found = this.tools.find((one) => Math.hypot(one.x_px - x, one.y_px - y) < 24);
    if (!found) return undefined;
    const frame = found.arm.measured_frames.at(-1);
    const place = frame.slice(0, 3).map((value) => value.toFixed(3)).join(", ");
    return `${found.side} tool, measured\nx, y, z: ${place} m\n${quantity(found.arm.tool_error_mm, "mm", 1)} from the command`;
  }

  summary(arms) {
    if (!arms) return "The arms; nothing heard yet.";
    const each = arms.arms.map((arm) => `${arm.side} arm: tool error ${quantity(arm.tool_error_mm, "mm", 1)}`);
    return `The arms in space. ${each.join("; ")}.`;
  }
}

function stroke(context, { a, b }, style, width, alpha, shift = 0) {
  context.globalAlpha = alpha;
  stroked(context, [a, b].map(({ x, y }) => [x + shift, y + shift]), style, width);
  context.globalAlpha = 1;
}

// A thick line, darker at its edge and with a light along it.
function paint(context, rod, colours) {
  const { width, colour } = rod;
  context.lineCap = "round";
  stroke(context, rod, colours.panel, width + 3, 1);
  stroke(context, rod, colour, width, 1);
  stroke(context, rod, "#000000", width, 0.16);
  stroke(context, rod, colour, width * 0.72, 0.9, -width * 0.05);
  stroke(context, rod, "#ffffff", width * 0.2, 0.28, -width * 0.15);
}

// A vector turned by a frame's quaternion [.., w, x, y, z].
function rotate(frame, [vx, vy, vz]) {
  const [, , , w, x, y, z] = frame;
  const tx = 2 * (y * vz - z * vy);
  const ty = 2 * (z * vx - x * vz);
  const tz = 2 * (x * vy - y * vx);
  return [vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx];
}

// Where each tool was over the last seconds, from messages oldest first.
export function trailsOf(messages) {
  const trails = {};
  for (const { value } of messages) {
    for (const arm of value.arms) {
      const frame = arm.measured_frames?.at(-1);
      if (frame) (trails[arm.side] ??= []).push(frame.slice(0, 3));
    }
  }
  return trails;
}

export { TRAIL_S };
