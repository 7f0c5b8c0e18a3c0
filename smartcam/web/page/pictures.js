// The newest frame of a source, one picture on the way at a time. One that nobody sees, as in a
// hidden tab, behind another that is enlarged or scrolled away, asks for none.

import { make, token } from "./base.js";

const OLD_S = 2; // a picture of before is called old, unless frames come more slowly
const WINDOW_S = 3; // over which rates are counted
const COUNTS = [
  ["age", "age"],
  ["shown", "shown"],
  ["camera", "camera"],
  ["skipped", "skipped"],
  ["lost", "lost"],
  ["number", "number"],
  ["format", "format"],
];

export class Source {
  // path: of its WebSocket; place: among others; lost: is called when the connection has gone, and
  // has connect() called.
  constructor({ name, path, place = 0, lost = () => this.connect() }) {
    Object.assign(this, { path, lost });
    this.counts = Object.fromEntries(COUNTS.map(([key]) => [key, make("dd", { "data-count": key, textContent: "-" })]));
    this.title = make("h2", { textContent: name });
    this.state = make("span", { className: "state", role: "status", textContent: "connecting" });
    this.why = make("p", { className: "why", role: "alert" });
    this.canvas = make("canvas", { width: 0, height: 0, hidden: true, role: "img", "aria-label": `Newest frame of ${name}` });
    this.empty = make("p", { className: "note", textContent: "No picture yet." });
    this.view = make("button", { type: "button", className: "view", "aria-label": `Enlarge ${name}`, "aria-pressed": "false" }, this.canvas, this.empty);
    const list = COUNTS.map(([key, label]) => make("div", {}, make("dt", { textContent: label }), this.counts[key]));
    this.panel = make("section", { className: "panel source", "data-place": String(place), "data-state": "wait", "aria-label": name },
      make("div", { className: "head" }, this.title, this.state), this.view, this.why, make("dl", { className: "counts" }, ...list));
    this.last = null; // the last picture: its age when it was sent, and when that came
    this.recent = []; // of the last seconds
    this.socket = null;
    this.pause = 300;
    this.retry = 0;
    this.seen = false; // whether any of it is on the screen
    this.ended = new AbortController();
    this.observer = new IntersectionObserver((entries) => {
      this.seen = entries.at(-1).isIntersecting;
      this.look();
    });
    this.observer.observe(this.panel);
    document.addEventListener("visibilitychange", () => this.look(), { signal: this.ended.signal });
  }

  // Show nothing more.
  end() {
    this.ended.abort();
    this.observer.disconnect();
    this.seen = false;
    this.disconnect();
  }

  get wanted() {
    return this.seen && !document.hidden;
  }

  // Connect where it is looked at, and not where it is not.
  look() {
    if (this.wanted) return this.connect();
    this.disconnect();
    this.told("wait", "");
    this.state.textContent = "paused";
  }

  connect() {
    if (this.socket || !this.wanted) return;
    clearTimeout(this.retry);
    this.recent = [];
    const protocols = ["smartcam.frames", ...(token() ? [`bearer.${token()}`] : [])];
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${this.path}`, protocols);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    let queue = Promise.resolve(); // what comes is dealt with in its order
    socket.addEventListener("message", ({ data }) => {
      const came = performance.now();
      queue = queue.then(() => this.take(socket, data, came)).catch((error) => this.told("lost", `A picture cannot be shown: ${error.message}`));
    });
    socket.addEventListener("close", () => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.told("wait", "");
      this.state.textContent = "not connected";
      this.retry = setTimeout(() => this.lost(), this.pause);
      this.pause = Math.min(5000, 2 * this.pause);
    });
  }

  disconnect() {
    const { socket } = this;
    this.socket = null;
    clearTimeout(this.retry);
    socket?.close();
  }

  told(state, text) {
    this.panel.dataset.state = state;
    this.state.textContent = { live: "live", no_frame_yet: "waiting for a frame", not_open: "not open", lost: "lost", ended: "ended", wait: "connecting" }[state];
    if (this.why.textContent !== text) this.why.textContent = text;
    if (state !== "live") for (const key of ["shown", "camera"]) this.count(key, "-");
    this.age();
  }

  take(socket, data, came) {
    if (this.socket !== socket) return undefined; // of before a pause
    return typeof data === "string" ? this.hear(JSON.parse(data)) : this.show(socket, data, came);
  }

  hear(value) {
    this.pause = 300;
    if (value.state) {
      this.recent = [];
      this.told(value.state, value.text ?? "");
      if (value.format) this.count("format", value.format);
    }
    if (value.counts) this.takeCounts(value.counts);
    if (value.bad) this.why.textContent = `A frame cannot be shown: ${value.bad}`;
  }

  async show(socket, data, came) {
    this.pause = 300;
    const length = new DataView(data).getUint32(0, true);
    const { frame, counts } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    try {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (this.socket !== socket) return bitmap.close();
      if (this.canvas.width !== bitmap.width) this.canvas.width = bitmap.width;
      if (this.canvas.height !== bitmap.height) this.canvas.height = bitmap.height;
      this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
      bitmap.close();
      this.canvas.hidden = false;
      this.empty.hidden = true;
      this.last = { age: frame.age, came };
      if (this.panel.dataset.state !== "live" || this.why.textContent) this.told("live", "");
    } catch (error) {
      if (this.socket !== socket) return;
      this.why.textContent = `The browser cannot read a picture: ${error.message}`;
    }
    if (socket.readyState === WebSocket.OPEN) socket.send("next");
    this.count("number", String(frame.sequence));
    this.count("format", `${frame.format} ${frame.width}x${frame.height}`);
    this.counts.age.title = `since the ${frame.moment}`;
    this.takeCounts(counts);
    this.age();
  }

  takeCounts(counts) {
    this.recent.push(counts);
    while (this.recent.length > 2 && counts.at - this.recent[0].at > WINDOW_S) this.recent.shift();
    const [first] = this.recent;
    const seconds = counts.at - first.at;
    for (const [key, name] of [["shown", "delivered"], ["camera", "offered"]]) {
      if (seconds > 0) this.count(key, `${((counts[name] - first[name]) / seconds).toFixed(1)}/s`);
    }
    this.count("skipped", String(counts.skipped));
    this.count("lost", counts.bad ? `${counts.lost}, ${counts.bad} not readable` : String(counts.lost));
    this.counts.lost.classList.toggle("warn", counts.lost + counts.bad > 0);
  }

  count(key, text) {
    if (this.counts[key].textContent !== text) this.counts[key].textContent = text;
  }

  age() {
    if (!this.last) return;
    const age = this.last.age + (performance.now() - this.last.came) / 1000;
    const old = age > Math.max(OLD_S, 2 * this.interval());
    this.panel.classList.toggle("old", old || this.panel.dataset.state !== "live");
    this.counts.age.classList.toggle("warn", old);
    this.count("age", `${age < 2 ? `${(1000 * age).toFixed(0)} ms` : `${age.toFixed(0)} s`}${old ? ": not fresh" : ""}`);
  }

  // Seconds between two frames of the camera, as far as they were counted.
  interval() {
    const [first, last] = [this.recent[0], this.recent.at(-1)];
    const count = last ? last.offered - first.offered : 0;
    return count ? (last.at - first.at) / count : 0;
  }
}
