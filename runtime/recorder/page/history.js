// The last minutes of each topic, bounded in age, number and bytes, and the moment the page shows.
// Messages are kept as they came and read when they are shown: scrubbing shows what was sent.

const decoder = new TextDecoder();

export const KEPT_S = 300;

export class Shelf {
  // `eager` reads messages when they come, for shelves whose every message is drawn. `spacing` thins
  // what is kept to one message per so many seconds, and the newest.
  constructor({ seconds = KEPT_S, bytes = 16e6, messages = 8000, spacing = 0, eager = false } = {}) {
    Object.assign(this, { seconds, maxBytes: bytes, maxMessages: messages, spacing, eager });
    this.clear();
  }

  clear() {
    this.times = [];
    this.bodies = [];
    this.sizes = [];
    this.start = 0;
    this.bytes = 0;
    this.held = -Infinity;
    this.cached = undefined;
  }

  get length() { return this.times.length - this.start; }
  get oldest() { return this.times[this.start]; }
  get newest() { return this.times[this.times.length - 1]; }

  push(time, bytes) {
    const body = this.eager ? JSON.parse(decoder.decode(bytes)) : bytes.slice();
    if (this.isBetween()) this.pop();
    this.times.push(time);
    this.bodies.push(body);
    this.sizes.push(bytes.length);
    this.bytes += bytes.length;
    while (this.length > 1 && this.isFull(time)) this.drop();
    if (this.start > 1024 && this.start * 2 > this.times.length) this.compact();
  }

  isFull(time) {
    return this.length > this.maxMessages || this.bytes > this.maxBytes
      || this.times[this.start + 1] < time - this.seconds;
  }

  // Whether the newest is too near to the one before it to be kept. What a pause shows is.
  isBetween() {
    return this.length > 1 && this.newest > this.held && this.newest - this.times[this.times.length - 2] < this.spacing;
  }

  pop() {
    this.times.pop();
    this.bodies.pop();
    this.bytes -= this.sizes.pop();
    this.cached = undefined;
  }

  drop() {
    this.bytes -= this.sizes[this.start];
    this.bodies[this.start] = undefined;
    this.start += 1;
  }

  compact() {
    for (const name of ["times", "bodies", "sizes"]) this[name] = this[name].slice(this.start);
    this.start = 0;
    this.cached = undefined;
  }

  // Index of the newest message at or before `time`; -1 when there is none.
  indexAt(time) {
    let [low, high] = [this.start, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle + 1; else high = middle;
    }
    return low - 1 >= this.start ? low - 1 : -1;
  }

  read(index) {
    if (this.eager) return this.bodies[index];
    if (this.cached?.index !== index) {
      this.cached = { index, value: JSON.parse(decoder.decode(this.bodies[index])) };
    }
    return this.cached.value;
  }

  // The message in force at `time`, with the moment it came.
  at(time) {
    const index = this.indexAt(time);
    return index < 0 ? undefined : { time: this.times[index], value: this.read(index) };
  }

  // Messages in (from, until], oldest first; of an eager shelf only.
  between(from, until) {
    const first = this.indexAt(from) + 1 || this.start;
    const last = this.indexAt(until);
    const found = [];
    for (let index = Math.max(first, this.start); index <= last; index += 1) {
      found.push({ time: this.times[index], value: this.bodies[index] });
    }
    return found;
  }
}

// Which moment is shown: the newest, or one that stands still.
export class View {
  constructor(shelves) {
    this.shelves = shelves;
    this.frozen = undefined;
  }

  get isPaused() { return this.frozen !== undefined; }

  get newest() {
    const { fleet, arms, channels, run } = this.shelves;
    const times = [fleet, arms, channels].map((shelf) => shelf.newest);
    if (times.every((time) => time === undefined)) return run.newest;
    const found = times.filter((time) => time !== undefined);
    return Math.max(...found);
  }

  // Where the past begins: with the scene, where there is one, lest one scrubs to an empty one.
  get oldest() {
    const { fleet, arms, channels } = this.shelves;
    return fleet.oldest ?? arms.oldest ?? channels.oldest ?? this.newest;
  }

  get moment() {
    if (!this.isPaused) return this.newest;
    return Math.max(this.frozen, this.oldest ?? this.frozen);
  }

  pauseAt(time) {
    if (this.newest === undefined) return;
    this.frozen = Math.min(Math.max(time, this.oldest), this.newest);
    this.hold(this.frozen);
  }

  goLive() {
    this.frozen = undefined;
    this.hold(-Infinity);
  }

  hold(time) {
    for (const shelf of Object.values(this.shelves)) shelf.held = time;
  }
}
