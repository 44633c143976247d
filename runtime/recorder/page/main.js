// The live page: joins the socket, the past and the panels. Starts by itself when the page is loaded.

import { ArmScene, TRAIL_S, trailsOf } from "./arms.js";
import { Conditions } from "./conditions.js";
import { FleetScene } from "./fleet.js";
import { age, byId, make, palette, seconds, write } from "./format.js";
import { Gestures } from "./gestures.js";
import { KEPT_S, Shelf, View } from "./history.js";
import { ChannelTable, armEvents, showEvents, showFacts, showRun, showWarnings } from "./panels.js";
import { Socket } from "./socket.js";
import { Strips } from "./strips.js";

const PANELS_EVERY_MS = 200;
const STRIP_MS_PER_S = 2.5;
const SILENT_S = 3;
const CONFIG_RETRY_MS = 1500;
const STEP_S = 0.5;
const SCENES = { fleet: "fleet", teleoperation: "arms" };

const shelves = {
  run: new Shelf({ eager: true }),
  map: new Shelf({ seconds: Infinity, messages: 4 }),
  channels: new Shelf({ eager: true, messages: 4000 }),
  losses: new Shelf({ eager: true, messages: 20000 }),
  fleet: new Shelf({ bytes: 96e6, spacing: 0.09 }),
  arms: new Shelf({ eager: true, messages: 7000 }),
};
const view = new View(shelves);
const canvas = byId("stage");
const scenes = { fleet: new FleetScene(canvas, byId("robots")), arms: new ArmScene(canvas, byId("robots")) };
const strips = new Strips(byId("strips"), byId("channel-choice"));
const table = new ChannelTable(byId("channel-table"), (name) => {
  strips.choose(name === strips.choice.value ? "" : name);
  redraw();
});
const conditions = new Conditions(byId("condition-list"), byId("conditions-none"), (parameter, id) => socket?.setParameter(parameter, id) ?? false);

let socket;
let colours = palette();
let scene; // "fleet", "arms" or undefined
let heardAt = performance.now();
let isStale = true; // something written is older than what is known
let isSceneStale = true; // something drawn is
let panelsAt = 0;
let stripsAt = 0;
let pointer;
let shownRun;

function redraw() {
  isStale = isSceneStale = true;
  panelsAt = stripsAt = 0;
}

function setState(state, words) {
  write(byId("connection"), words);
  if (document.body.dataset.state === state) return;
  document.body.dataset.state = state;
  byId("lost").hidden = state !== "lost";
  redraw();
}

// ---- what comes in ----

let session;
const handlers = {
  opened(info) {
    if (session !== undefined && info.sessionId !== session) clear();
    session = info.sessionId;
    heardAt = performance.now();
    setState(shelves.run.length > 0 ? "live" : "waiting", "connected");
  },
  message(topic, time, bytes) {
    const shelf = shelves[topic.slice("/live/".length)];
    // Time that runs backwards is another run, or the same one played again.
    if (shelf.newest !== undefined && time < shelf.newest - 0.5) clear();
    shelf.push(time, bytes);
    heardAt = performance.now();
    isStale = true;
    if (shelf === shelves.run) runChanged(shelf.read(shelf.times.length - 1));
    if (shelf !== shelves.channels && !view.isPaused) isSceneStale = true;
    if (shelf === shelves.fleet || shelf === shelves.arms) showScene(shelf === shelves.fleet ? "fleet" : "arms");
  },
  parameters(list) {
    for (const parameter of list) conditions.confirm(parameter.name, parameter.value);
  },
  lost() {
    conditions.forget();
    setState(shownRun === undefined ? "connecting" : "lost", shownRun === undefined ? "no recorder yet, retrying" : "connection lost, retrying");
  },
  status(level, text) {
    if (level > 0) write(byId("connection"), text);
  },
};

function runChanged(run) {
  if (shownRun !== undefined && shownRun !== run.name && run.name !== null) {
    for (const name of ["channels", "losses", "fleet", "arms"]) shelves[name].clear();
    view.goLive();
    document.body.dataset.scene = "none";
    scene = undefined;
    shelves.map.clear();
    byId("robots").replaceChildren();
  }
  shownRun = run.name;
  conditions.offer(run.links ?? []);
  if (!scene) document.body.dataset.scene = SCENES[run.case] || run.case === null ? "none" : "absent";
  setState(run.state === "waiting" ? "waiting" : "live", "connected");
}

function clear() {
  for (const name of ["run", "channels", "losses", "fleet", "arms"]) shelves[name].clear();
  view.goLive();
}

function showScene(name) {
  if (scene === name) return;
  scene = name;
  document.body.dataset.scene = name;
  byId("robots").replaceChildren();
  scenes[name].chips.clear();
  byId("legend").replaceChildren(...scenes[name].legend());
  write(byId("scene-title"), name === "fleet" ? "Fleet" : "Arms");
}

// ---- what is shown ----

const at = (name, moment) => (moment === undefined ? undefined : shelves[name].at(moment)?.value);

function drawScene(moment) {
  if (scene === "fleet") {
    const fleet = at("fleet", moment);
    scenes.fleet.draw(shelves.map.at(Infinity)?.value, fleet, colours);
    write(byId("basis"), fleet?.basis === "states" ? "collisions by reported states" : "");
  } else if (scene === "arms") {
    const arms = at("arms", moment);
    scenes.arms.draw(arms, colours, trailsOf(shelves.arms.between(moment - TRAIL_S, moment)));
  }
  if (scene) showNote();
}

function showNote() {
  const note = byId("stage-note");
  const words = pointer && scenes[scene].describe(...pointer);
  note.hidden = !words;
  if (!words) return;
  write(note, words);
  const left = Math.min(pointer[0] + 14, canvas.clientWidth - note.offsetWidth - 4);
  note.style.left = `${Math.max(left, 0)}px`;
  note.style.top = `${Math.max(pointer[1] - note.offsetHeight - 10, 0)}px`;
}

function elapsedAt(moment) {
  const found = shelves.run.at(moment);
  if (!found || found.value.elapsed_s === null) return null;
  const { value, time } = found;
  return value.state === "running" ? value.elapsed_s + Math.min(moment - time, 1.2) * (value.speed || 1) : value.elapsed_s;
}

function drawPanels(moment) {
  // Unless a past moment is looked at, what is known of the run itself is the newest: it goes on being told
  // after the last figures have come.
  const run = (view.isPaused ? shelves.run.at(moment)?.value : undefined) ?? shelves.run.at(Infinity)?.value;
  if (!run) return;
  showRun(run, elapsedAt(moment));
  const stretch_s = strips.stretch(moment - (shelves.channels.oldest ?? moment));
  const samples = shelves.channels.between(moment - stretch_s - 1, moment);
  const newest = samples.at(-1)?.value ?? at("channels", moment);
  showFacts(run, newest);
  showWarnings(run);
  // A loss is drawn when the message was published, not when it was found missing.
  const losses = shelves.losses.between(moment - KEPT_S, moment).map(({ time, value }) => ({
    ...value, time: time - (value.first_at_s === null ? 0 : value.at_s - value.first_at_s) }));
  if (newest) {
    table.show(newest.channels, run, strips.choice.value);
    strips.offer(newest.channels.map((channel) => channel.name));
    drawStrips(samples, losses, moment);
    write(byId("axis-start"), `${Math.round(stretch_s)} s before`);
    write(byId("axis-end"), view.isPaused ? "moment shown" : document.body.dataset.state === "lost" ? "last heard" : "now");
  }
  const fleet = scene === "fleet" ? at("fleet", moment) : undefined;
  showEvents(losses, fleet?.collisions ?? [], armEvents(shelves.arms.between(moment - KEPT_S, moment)));
  if (scene) canvas.setAttribute("aria-label", scenes[scene].summary(at(scene, moment)));
  offerFleets();
}

// A pixel of a long stretch is seconds wide: drawing it more often would show nothing new.
function drawStrips(samples, losses, moment) {
  const now = performance.now();
  if (now < stripsAt + strips.drawn_s * STRIP_MS_PER_S) return;
  stripsAt = now;
  strips.draw(samples, losses, moment, colours);
}

function offerFleets() {
  const group = byId("fleet-choice");
  const number = scene === "fleet" ? shelves.map.at(Infinity)?.value.fleet_count ?? 1 : 1;
  group.hidden = number < 2;
  if (group.childElementCount !== number && number > 1) {
    group.replaceChildren(...Array.from({ length: number }, (_, fleet) => {
      const button = make("button", { type: "button" }, `fleet ${fleet}`);
      button.addEventListener("click", () => {
        scenes.fleet.fleet = fleet;
        redraw();
      });
      return button;
    }));
  }
  [...group.children].forEach((button, fleet) => button.setAttribute("aria-pressed", String(fleet === scenes.fleet.fleet)));
}

function drawTransport(moment) {
  document.body.dataset.paused = String(view.isPaused);
  byId("pause").setAttribute("aria-pressed", String(view.isPaused));
  write(byId("pause"), view.isPaused ? "Go on" : "Pause");
  byId("live").setAttribute("aria-pressed", String(!view.isPaused));
  const scrub = byId("scrub");
  if (moment === undefined) return;
  const [past, back] = [view.newest - view.oldest, view.newest - moment];
  scrub.min = (-past).toFixed(1);
  scrub.value = (-back).toFixed(1);
  const isLost = document.body.dataset.state === "lost";
  const words = view.isPaused ? `paused, ${seconds(back)} ago` : `${isLost ? "last heard" : "live"}, ${seconds(past, 0)} kept`;
  const elapsed = elapsedAt(moment);
  scrub.setAttribute("aria-valuetext", words);
  write(byId("moment"), elapsed === null ? words : `at ${seconds(elapsed)} · ${words}`);
}

function watchSilence(now) {
  const run = shelves.run.at(Infinity)?.value;
  const silent_s = (now - heardAt) / 1000;
  if (document.body.dataset.state !== "live" || run?.state !== "running") return;
  write(byId("connection"), silent_s > SILENT_S ? `connected, silent for ${age(Math.floor(silent_s))}` : "connected");
}

function frame(now) {
  requestAnimationFrame(frame);
  watchSilence(now);
  const moment = view.moment;
  if (isSceneStale) drawScene(moment);
  isSceneStale = false;
  if (!isStale || now - panelsAt < PANELS_EVERY_MS) return;
  isStale = false;
  panelsAt = now;
  drawTransport(moment);
  if (moment !== undefined) drawPanels(moment);
}

// ---- what the user does ----

function pauseAt(time) {
  view.pauseAt(time);
  redraw();
}

function goLive() {
  view.goLive();
  redraw();
}

function toggle() {
  if (view.isPaused) goLive(); else if (view.newest !== undefined) pauseAt(view.newest);
}

function listen() {
  byId("pause").addEventListener("click", toggle);
  byId("live").addEventListener("click", goLive);
  byId("scrub").addEventListener("input", (event) => pauseAt(view.newest + Number(event.target.value)));
  byId("channel-choice").addEventListener("change", redraw);
  byId("span-choice").addEventListener("change", (event) => {
    strips.span_s = Number(event.target.value);
    redraw();
  });
  byId("log-axis").addEventListener("change", (event) => {
    strips.isLog = event.target.checked;
    redraw();
  });
  const zoom = (factor) => act((one) => one.zoomBy(factor, canvas.clientWidth / 2, canvas.clientHeight / 2));
  byId("zoom-in").addEventListener("click", () => zoom(1.3));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 1.3));
  byId("zoom-all").addEventListener("click", () => act((one) => one.reset()));
  window.addEventListener("resize", redraw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    colours = palette();
    redraw();
  });
  document.addEventListener("keydown", keyPressed);
}

function act(change) {
  if (scene) change(scenes[scene]);
  redraw();
}

function keyPressed(event) {
  const isTyping = event.target.closest?.("input, select, textarea, button, summary");
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const isRange = event.target.id === "scrub";
  if (isTyping && !(isRange && event.key === " ")) return;
  const steps = { ArrowLeft: -STEP_S, ArrowRight: STEP_S };
  if (event.key === " ") toggle();
  else if (event.key === "l" || event.key === "L") goLive();
  else if (steps[event.key] && view.moment !== undefined) pauseAt(view.moment + steps[event.key]);
  else return;
  event.preventDefault();
}

async function start() {
  listen();
  new Gestures(canvas, {
    drag: (dx, dy) => act((one) => one.drag(dx, dy)),
    zoom: (factor, x, y) => act((one) => one.zoomBy(factor, x, y)),
    reset: () => act((one) => one.reset()),
    point: (x, y) => {
      pointer = x === undefined ? undefined : [x, y];
      isSceneStale = true;
    },
  });
  requestAnimationFrame(frame);
  for (;;) {
    try {
      const config = await (await fetch("config.json", { cache: "no-store" })).json();
      socket = new Socket(`ws://${location.hostname}:${config.ws_port}/${location.search}`, (topic) => topic.startsWith("/live/") && topic.slice(6) in shelves, handlers);
      return;
    } catch {
      setState("connecting", "no recorder yet, retrying");
      await new Promise((resolve) => setTimeout(resolve, CONFIG_RETRY_MS));
    }
  }
}

// What the page shows, as values: for tests and for the browser's console.
window.hil = {
  snapshot() {
    const moment = view.moment;
    return {
      state: document.body.dataset.state, is_paused: view.isPaused, scene: scene ?? null, moment: moment ?? null,
      elapsed_s: moment === undefined ? null : elapsedAt(moment), kept_s: moment === undefined ? 0 : view.newest - view.oldest,
      kept_bytes: Object.fromEntries(Object.entries(shelves).map(([name, shelf]) => [name, shelf.bytes])),
      run: shelves.run.at(Infinity)?.value ?? null, channels: at("channels", moment) ?? null,
      fleet: at("fleet", moment) ?? null, arms: at("arms", moment) ?? null,
      robots: scenes.fleet.drawn.map(({ robot, x_px, y_px }) => ({ fleet: robot.fleet, id: robot.id, x_px, y_px })),
      tools: scenes.arms.tools.map(({ side, x_px, y_px }) => ({ side, x_px, y_px })),
      conditions: Object.fromEntries(conditions.confirmed),
    };
  },
};

start();
