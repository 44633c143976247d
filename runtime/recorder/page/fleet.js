// The fleet from above: ground, ways, critical sections, vehicles to scale and where they met.

import { FONT, age, chipOf, isEmpty, keepOnly, legendEntry, polyline, quantity, stroked, surface, write } from "./format.js";

const PADDING_PX = 14;
const NUMBER_FITS_PX = 15;
const FRESH_COLLISION_S = 5;
const MOST_ZOOM = 12;

export class FleetScene {
  constructor(canvas, robots) {
    Object.assign(this, { canvas, robots, fleet: 0, zoom: 1, pan: [0, 0], drawn: [], chips: new Map() });
  }

  legend() {
    return [legendEntry("thick", "way granted"), legendEntry("dashed", "planned way"), legendEntry("area", "section, colour: who may pass"),
      legendEntry("both", "granted to both at once"), legendEntry("stale", "stale"), legendEntry("cross", "collision", "×")];
  }

  drag(dx, dy) {
    this.pan = [this.pan[0] + dx, this.pan[1] + dy];
  }

  zoomBy(factor, x, y) {
    const zoom = Math.min(Math.max(this.zoom * factor, 1), MOST_ZOOM);
    const real = zoom / this.zoom;
    const centre = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const towards = (at, middle, pan) => (at - middle) * (1 - real) + pan * real;
    this.pan = zoom === 1 ? [0, 0] : [towards(x, centre[0], this.pan[0]), towards(y, centre[1], this.pan[1])];
    this.zoom = zoom;
  }

  reset() {
    this.zoom = 1;
    this.pan = [0, 0];
  }

  // Metres to pixels: the whole ground fits, y points up.
  fit(bounds, width, height) {
    const wide = Math.max(bounds.x_max_m - bounds.x_min_m, 1);
    const high = Math.max(bounds.y_max_m - bounds.y_min_m, 1);
    const room = Math.min((width - 2 * PADDING_PX) / wide, (height - 2 * PADDING_PX) / high);
    this.scale = room * this.zoom;
    const middle = [(bounds.x_min_m + bounds.x_max_m) / 2, (bounds.y_min_m + bounds.y_max_m) / 2];
    this.origin = [width / 2 + this.pan[0] - middle[0] * this.scale, height / 2 + this.pan[1] + middle[1] * this.scale];
  }

  at(x_m, y_m) {
    return [this.origin[0] + x_m * this.scale, this.origin[1] - y_m * this.scale];
  }

  draw(map, fleet, colours) {
    const { context, width, height } = surface(this.canvas);
    this.drawn = [];
    this.labels = [];
    if (!map || !map.bounds) return;
    this.canvas.style.setProperty("--ground", aspect(map.bounds));
    if (isEmpty(this.canvas)) return;
    this.fit(map.bounds, width, height);
    this.colours = colours;
    this.ground(context, map, width, height);
    const shown = (one) => one.fleet === this.fleet;
    const robots = (fleet?.robots ?? []).filter(shown);
    for (const section of (fleet?.sections ?? []).filter(shown)) this.section(context, section);
    for (const robot of robots) this.way(context, robot);
    for (const robot of robots) this.vehicle(context, robot, map.footprint);
    for (const hit of (fleet?.collisions ?? []).filter(shown)) this.collision(context, hit, fleet.at_s);
    for (const robot of robots) this.outsideLabel(context, robot);
    this.scaleBar(context, width, height);
    this.list(robots, fleet);
  }

  colourOf(robot) {
    return robot.is_stale ? this.colours.faint : this.colours.series[robot.id % 7];
  }

  trace(context, points, isClosed) {
    polyline(context, points.map(([x, y]) => this.at(x, y)), isClosed);
  }

  // What does not move is drawn once per size, zoom and colour scheme.
  ground(context, map, width, height) {
    const key = [width, height, this.scale, ...this.origin, this.colours.paper].join();
    const ratio = this.canvas.width / width;
    if (this.ground_?.key !== key || this.ground_.map !== map) {
      const sheet = document.createElement("canvas");
      sheet.width = this.canvas.width;
      sheet.height = this.canvas.height;
      const pen = sheet.getContext("2d");
      pen.scale(ratio, ratio);
      this.drawGround(pen, map);
      this.ground_ = { key, map, sheet };
    }
    context.drawImage(this.ground_.sheet, 0, 0, width, height);
  }

  drawGround(pen, map) {
    const { colours } = this;
    const corner = (area) => {
      const [left, top] = this.at(area.x_min_m, area.y_max_m);
      return [left, top, (area.x_max_m - area.x_min_m) * this.scale, (area.y_max_m - area.y_min_m) * this.scale];
    };
    pen.fillStyle = colours.paper;
    pen.strokeStyle = colours.rule;
    pen.lineWidth = 1;
    pen.fillRect(...corner(map.bounds));
    pen.strokeRect(...corner(map.bounds));
    pen.fillStyle = colours.ink;
    pen.globalAlpha = 0.045;
    for (const area of map.conflict_areas ?? []) {
      this.trace(pen, area, true);
      pen.fill();
    }
    pen.globalAlpha = 1;
    pen.strokeStyle = colours.rule;
    pen.lineWidth = 0.7;
    for (const path of map.paths ?? []) {
      this.trace(pen, path.points, false);
      pen.stroke();
    }
    pen.fillStyle = colours.tint;
    pen.lineWidth = 1;
    for (const area of map.obstacles ?? []) {
      pen.fillRect(...corner(area));
      pen.strokeRect(...corner(area));
    }
    for (const bay of map.bays ?? []) this.bay(pen, bay, map.footprint);
  }

  bay(pen, bay, footprint) {
    const [x, y] = this.at(bay.x_m, bay.y_m);
    const long = (footprint?.length_m ?? 1) * this.scale * 1.25;
    const wide = (footprint?.width_m ?? 1) * this.scale * 1.35;
    pen.save();
    pen.translate(x, y);
    pen.rotate(-bay.heading_rad);
    pen.setLineDash([3, 3]);
    pen.strokeStyle = this.colours.faint;
    pen.globalAlpha = 0.55;
    pen.strokeRect(-long / 2, -wide / 2, long, wide);
    pen.restore();
  }

  section(context, section) {
    const { colours } = this;
    // A robot may follow another through: contested is where their grants meet.
    const [one] = section.may_pass;
    const isContested = section.is_contested;
    const colour = isContested ? colours.bad : one === undefined ? colours.faint : colours.series[one % 7];
    this.trace(context, section.polygon, true);
    context.fillStyle = colour;
    context.globalAlpha = one === undefined ? 0.08 : 0.26;
    context.fill();
    context.globalAlpha = one === undefined ? 0.5 : 0.9;
    context.strokeStyle = colour;
    context.lineWidth = section.inside.length > 0 ? 2.2 : 1.1;
    context.stroke();
    context.globalAlpha = 1;
  }

  way(context, robot) {
    context.strokeStyle = this.colourOf(robot);
    context.lineJoin = "round";
    context.lineCap = "butt";
    if (robot.ahead?.length > 1) {
      context.setLineDash([4, 4]);
      context.globalAlpha = 0.6;
      context.lineWidth = 1.2;
      this.trace(context, robot.ahead, false);
      context.stroke();
    }
    context.setLineDash([]);
    if (robot.granted?.length > 1) {
      context.globalAlpha = 0.5;
      context.lineWidth = 2.6;
      this.trace(context, robot.granted, false);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  vehicle(context, robot, footprint) {
    const [x, y] = this.at(robot.x_m, robot.y_m);
    const long = Math.max((footprint?.length_m ?? 1) * this.scale, 5);
    const wide = Math.max((footprint?.width_m ?? 1) * this.scale, 3.5);
    this.drawn.push({ robot, x_px: x, y_px: y, reach_px: Math.max(long / 2, 12), long, wide });
    const colour = this.colourOf(robot);
    context.save();
    context.translate(x, y);
    context.rotate(-robot.heading_rad);
    context.beginPath();
    context.roundRect(-long / 2, -wide / 2, long, wide, Math.min(wide * 0.22, 4));
    context.fillStyle = robot.is_stale ? this.colours.panel : colour;
    context.fill();
    context.setLineDash(robot.is_stale ? [3, 2] : []);
    context.strokeStyle = robot.is_stale ? colour : this.colours.ink;
    context.lineWidth = robot.is_stale ? 1.6 : 1.2;
    context.stroke();
    context.setLineDash([]);
    // The bow: a light wedge at the end that goes first.
    polyline(context, [[long * 0.44, 0], [long * 0.27, wide * 0.3], [long * 0.27, -wide * 0.3]]);
    context.fillStyle = robot.is_stale ? colour : this.colours.panel;
    context.globalAlpha = 0.85;
    context.fill();
    context.restore();
    if (wide >= NUMBER_FITS_PX) {
      context.font = `600 ${Math.min(wide * 0.72, 15)}px ${FONT}`;
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillStyle = robot.is_stale ? colour : this.colours.panel;
      context.fillText(String(robot.id), x - Math.cos(robot.heading_rad) * long * 0.08, y + Math.sin(robot.heading_rad) * long * 0.08 + 0.5);
    }
  }

  // Numbers of small vehicles, and ages of stale ones, beside them.
  outsideLabel(context, robot) {
    const { x_px, y_px, wide, long } = this.drawn.find((one) => one.robot === robot);
    const words = [wide >= NUMBER_FITS_PX ? "" : String(robot.id), robot.is_stale ? age(robot.age_s) : ""].filter(Boolean).join(" · ");
    if (!words) return;
    const rise = Math.abs(Math.sin(robot.heading_rad)) * long / 2 + Math.abs(Math.cos(robot.heading_rad)) * wide / 2;
    context.font = `600 12px ${FONT}`;
    const [x, y] = this.freePlace(x_px, y_px, rise, context.measureText(words).width);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 3;
    context.lineJoin = "round";
    context.strokeStyle = this.colours.paper;
    context.strokeText(words, x, y);
    context.fillStyle = this.colourOf(robot);
    context.fillText(words, x, y);
  }

  // Above, below or beside a vehicle: the first place without another's label; above, if there is none.
  freePlace(x, y, rise, width) {
    const [up, aside] = [rise + 7, rise + 8 + width / 2];
    const places = [[x, y - up], [x, y + up], [x - aside, y], [x + aside, y], [x, y - up - 12]];
    const isFree = ([left, top]) => top > 8 && this.labels.every((label) => Math.abs(label[0] - left) > (label[2] + width) / 2 || Math.abs(label[1] - top) > 12);
    const place = places.find(isFree) ?? places[0];
    this.labels.push([...place, width]);
    return place;
  }

  collision(context, hit, at_s) {
    const [x, y] = this.at(hit.x_m, hit.y_m);
    const isFresh = at_s - hit.at_s < FRESH_COLLISION_S;
    const arm = isFresh ? 8 : 4;
    context.strokeStyle = this.colours.bad;
    context.globalAlpha = isFresh ? 1 : 0.45;
    context.lineWidth = isFresh ? 2.5 : 1.5;
    context.beginPath();
    context.moveTo(x - arm, y - arm);
    context.lineTo(x + arm, y + arm);
    context.moveTo(x - arm, y + arm);
    context.lineTo(x + arm, y - arm);
    context.stroke();
    if (isFresh) {
      context.beginPath();
      context.arc(x, y, 15, 0, 2 * Math.PI);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  // In the middle, for bays and their numbers are at the sides.
  scaleBar(context, width, height) {
    const wanted_m = 90 / this.scale;
    const decade = 10 ** Math.floor(Math.log10(wanted_m));
    const length_m = [5, 2, 1].map((step) => step * decade).find((step) => step <= wanted_m);
    const [left, right, bottom] = [width / 2 - (length_m * this.scale) / 2, width / 2 + (length_m * this.scale) / 2, height - 3];
    context.fillStyle = this.colours.faint;
    stroked(context, [[left, bottom - 4], [left, bottom], [right, bottom], [right, bottom - 4]], this.colours.faint, 1.5);
    context.font = `12px ${FONT}`;
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.fillText(`${length_m} m`, right + 6, bottom);
  }

  // The same in words, for those who do not see the drawing, and for tests.
  list(robots, fleet) {
    const present = new Set();
    for (const robot of robots) {
      const key = `${robot.fleet}/${robot.id}`;
      present.add(key);
      if (!this.chips.has(key)) this.chips.set(key, chipOf(this.robots, String(robot.id), { "data-robot": key }));
      const { item, mark, text } = this.chips.get(key);
      const drawn = this.drawn.find((one) => one.robot === robot);
      item.classList.toggle("stale", robot.is_stale);
      item.classList.toggle("bad", (fleet.collisions ?? []).some((hit) => hit.fleet === robot.fleet
        && hit.robots.includes(robot.id) && fleet.at_s - hit.at_s < FRESH_COLLISION_S));
      const does = robot.is_stale ? `stale, ${age(robot.age_s)}` : robot.is_waiting ? "waits" : robot.phase.replace("-", " ");
      write(text, `${quantity(robot.speed_mps, "m/s", 1)} · ${does}`);
      mark.style.background = this.colours.series[robot.id % 7];
      Object.assign(text.dataset, { x: drawn.x_px.toFixed(1), y: drawn.y_px.toFixed(1), xM: robot.x_m, yM: robot.y_m });
    }
    keepOnly(this.chips, present);
  }

  // What is under the pointer, in words.
  describe(x, y) {
    const found = this.drawn.find((one) => Math.hypot(one.x_px - x, one.y_px - y) < one.reach_px);
    if (!found) return undefined;
    const { robot } = found;
    return [`robot ${robot.id} of fleet ${robot.fleet}: ${robot.is_waiting ? "waits" : robot.phase.replace("-", " ")}`,
      `${quantity(robot.speed_mps, "m/s", 2)}, at ${quantity(robot.x_m, "m", 1)}, ${quantity(robot.y_m, "m", 1)}`,
      `may go ${quantity(robot.granted_m, "m", 1)}${robot.goal === null ? "" : `, to bay ${robot.goal}`}`,
      `last heard ${age(robot.age_s)} ago`].join("\n");
  }

  summary(fleet) {
    if (!fleet) return "The fleet from above; nothing heard yet.";
    const robots = fleet.robots.filter((robot) => robot.fleet === this.fleet);
    const driving = robots.filter((robot) => robot.phase === "driving").length;
    return `Fleet ${this.fleet} from above: ${robots.length} robots, ${driving} driving; collisions of all fleets so far: ${fleet.collision_count}.`;
  }
}

// Width to height of the canvas in which the ground fits without empty bands.
function aspect(bounds) {
  const ratio = (bounds.x_max_m - bounds.x_min_m) / Math.max(bounds.y_max_m - bounds.y_min_m, 1);
  return Math.min(Math.max(ratio, 1), 3).toFixed(3);
}
