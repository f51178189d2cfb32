// The page's one WebSocket: hands messages to who listens, connects again by itself, and knows how old all is.

/** Without news of the robot for this long the page shows everything as stale, ms. */
const STALE_MS = 700;
/** Status comes once a second on the robot, and at least every ten on a remote link. */
const STATUS_OLD_MS = 12500;
const STATUS_YOUNG_MS = 2500;
const RETRY_MS = 500;
const POINTS = 1;
const POSES = 2;

class Stream {
  constructor() {
    this.listeners = new Map();
    this.last = new Map();
    /** Milliseconds from the sensors' stamp to the frame drawn, the newest; script time of drawing; frames drawn. */
    this.stats = { latency: null, script: 0, frames: 0, detail: 1 };
    this.link = { state: "none", age: null };
    this.started = false;
    this.seeking = null;
    this.heardAt = -Infinity;
    this.readingsAt = -Infinity;
  }

  /** Calls back with every message of a kind, and with the last one that came before. */
  on(kind, callback) {
    if (!this.listeners.has(kind)) this.listeners.set(kind, new Set());
    this.listeners.get(kind).add(callback);
    if (this.last.has(kind)) callback(this.last.get(kind));
    return () => this.listeners.get(kind).delete(callback);
  }

  emit(kind, message, keep = true) {
    if (keep) this.last.set(kind, message);
    for (const callback of this.listeners.get(kind) ?? []) callback(message);
  }

  start() {
    if (this.started) return;
    this.started = true;
    setInterval(() => this.judge(), 100);
    this.connect();
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/stream`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      if (this.seeking !== null) this.seek(this.seeking);
    };
    this.socket.onmessage = (event) => this.take(event.data);
    this.socket.onclose = () => setTimeout(() => this.connect(), RETRY_MS);
  }

  take(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      const now = performance.now();
      if (message.kind === "live" && !message.past) this.heardAt = now;
      if (message.kind === "readings") {
        this.readingsAt = now;
        this.readings = message;
      }
      this.emit(message.kind, message);
      if (message.kind === "readings") this.judge();
      return;
    }
    const [kind, first, count] = new Uint32Array(data, 0, 3);
    if (kind === POINTS) this.emit("points", { chunk: first, points: new Int16Array(data, 12, 4 * count) }, false);
    if (kind === POSES) this.emit("poses", { first, values: new Float32Array(data, 12, 8 * count) }, false);
  }

  /** Show the robot as it was at a UNIX time in ms; null: as it is now. */
  seek(stamp) {
    this.seeking = stamp;
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ seek: stamp }));
  }

  judge() {
    const now = performance.now();
    const silence = now - this.readingsAt;
    let state = "none";
    let age = null;
    if (this.readings && this.readings.progress !== null) state = silence > STALE_MS ? "stale" : "recording";
    else if (this.readings && this.readings.age !== null) {
      age = Math.min(now - this.heardAt, 1000 * this.readings.age + silence);
      // A console that does not answer is as stale as a robot that does not.
      state = age > STALE_MS || silence > 2 * STALE_MS ? "stale" : "live";
    } else if (this.readings && silence > STALE_MS) state = "stale";
    const statusAge = this.readings?.status_age == null ? Infinity : 1000 * this.readings.status_age + silence;
    // Poses may end while the robot's program goes on and says why.
    const heard = statusAge < STATUS_YOUNG_MS && silence < 2 * STALE_MS;
    document.body.dataset.link = state;
    document.body.dataset.status = state === "recording" || statusAge < STATUS_OLD_MS ? "fresh" : "stale";
    document.body.dataset.heard = heard;
    const changed = state !== this.link.state;
    this.link = { state, age, heard, console: silence < 2 * STALE_MS };
    if (changed || state === "stale") this.emit("link", this.link);
  }
}

export const stream = new Stream();
window.robominerStream = stream;
