// Drag, pinch, wheel and keys of the scene, told as movements; what they move is the scene's business.

const WHEEL_FACTOR = 1.0015;
const KEY_STEP_PX = 30;

export class Gestures {
  // handlers: drag(dx, dy), zoom(factor, x, y), reset(), point(x, y) or point() when the pointer left.
  constructor(canvas, handlers) {
    this.canvas = canvas;
    this.handlers = handlers;
    this.held = new Map();
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.held.delete(event.pointerId));
    }
    canvas.addEventListener("pointerleave", () => handlers.point());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("dblclick", () => handlers.reset());
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  press(event) {
    this.held.set(event.pointerId, this.place(event));
    this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    const place = this.place(event);
    const before = this.held.get(event.pointerId);
    if (!before) return this.handlers.point(...place);
    this.held.set(event.pointerId, place);
    const other = [...this.held].find(([id]) => id !== event.pointerId)?.[1];
    if (!other) return this.handlers.drag(place[0] - before[0], place[1] - before[1]);
    const apart = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
    this.handlers.zoom(apart(place) / apart(before), (place[0] + other[0]) / 2, (place[1] + other[1]) / 2);
  }

  // A plain wheel scrolls the page as anywhere; with Ctrl, or a pinch on a touch pad, it zooms.
  wheel(event) {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    this.handlers.zoom(WHEEL_FACTOR ** -event.deltaY, ...this.place(event));
  }

  key(event) {
    const [x, y] = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const moves = {
      ArrowLeft: () => this.handlers.drag(-KEY_STEP_PX, 0),
      ArrowRight: () => this.handlers.drag(KEY_STEP_PX, 0),
      ArrowUp: () => this.handlers.drag(0, -KEY_STEP_PX),
      ArrowDown: () => this.handlers.drag(0, KEY_STEP_PX),
      "+": () => this.handlers.zoom(1.25, x, y),
      "-": () => this.handlers.zoom(0.8, x, y),
      0: () => this.handlers.reset(),
    };
    if (!moves[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    moves[event.key]();
  }
}
