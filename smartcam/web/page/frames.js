// The page of frames: the newest of each source, one picture on the way at a time. A page that is
// not looked at, as in a hidden tab, asks for none.

import { $, make, setText } from "./base.js";

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

let token = null;
let sources = [];
let reached = false; // whether the page's own server answers

// ---------------------------------------------------------------------- one source

class Source {
  constructor({ place, name }) {
    this.place = place;
    this.counts = Object.fromEntries(COUNTS.map(([key]) => [key, make("dd", { "data-count": key, textContent: "-" })]));
    this.title = make("h2", { textContent: name });
    this.state = make("span", { className: "state", role: "status", textContent: "connecting" });
    this.why = make("p", { className: "why", role: "alert" });
    this.canvas = make("canvas", { width: 0, height: 0, hidden: true, role: "img", "aria-label": `Newest frame of ${name}` });
    this.empty = make("p", { className: "note", textContent: "No picture yet." });
    const list = COUNTS.map(([key, label]) => make("div", {}, make("dt", { textContent: label }), this.counts[key]));
    this.panel = make("section", { className: "panel source", "data-place": String(place), "data-state": "wait", "aria-label": name },
      make("div", { className: "head" }, this.title, this.state), make("div", { className: "view" }, this.canvas, this.empty), this.why, make("dl", { className: "counts" }, ...list));
    this.last = null; // the last picture: its age when it was sent, and when that came
    this.accounts = []; // of the last seconds
    this.socket = null;
    this.pause = 300;
    this.retry = 0;
  }

  connect() {
    if (this.socket || document.hidden) return;
    clearTimeout(this.retry);
    this.accounts = [];
    const protocols = ["smartcam.frames", ...(token ? [`bearer.${token}`] : [])];
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/sources/${this.place}/pictures`, protocols);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    let queue = Promise.resolve(); // what comes is dealt with in its order
    socket.addEventListener("message", ({ data }) => {
      const came = performance.now();
      queue = queue.then(() => (typeof data === "string" ? this.hear(JSON.parse(data)) : this.show(socket, data, came))).catch((error) => this.told("lost", `A picture cannot be shown: ${error.message}`));
    });
    socket.addEventListener("close", () => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.told("wait", "");
      this.state.textContent = document.hidden ? "paused" : "not connected";
      if (document.hidden) return;
      this.retry = setTimeout(() => look(), this.pause);
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
    this.state.textContent = { live: "live", waiting: "waiting for a frame", awaited: "awaited", lost: "lost", ended: "ended", wait: "connecting" }[state];
    if (this.why.textContent !== text) this.why.textContent = text;
    if (state !== "live") for (const key of ["shown", "camera"]) this.count(key, "-");
    this.age();
  }

  hear(value) {
    this.pause = 300;
    if (value.state) {
      this.accounts = [];
      this.told(value.state, value.text ?? "");
      if (value.format) this.count("format", value.format);
    }
    if (value.account) this.account(value.account);
    if (value.bad) this.why.textContent = `A frame cannot be shown: ${value.bad}`;
  }

  async show(socket, data, came) {
    this.pause = 300;
    const length = new DataView(data).getUint32(0, true);
    const { frame, account } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    try {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (this.canvas.width !== bitmap.width) this.canvas.width = bitmap.width;
      if (this.canvas.height !== bitmap.height) this.canvas.height = bitmap.height;
      this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
      bitmap.close();
      this.canvas.hidden = false;
      this.empty.hidden = true;
      this.last = { age: frame.age, came };
      if (this.panel.dataset.state !== "live" || this.why.textContent) this.told("live", "");
    } catch (error) {
      this.why.textContent = `The browser cannot read a picture: ${error.message}`;
    }
    if (socket.readyState === WebSocket.OPEN) socket.send("next");
    this.count("number", String(frame.sequence));
    this.count("format", `${frame.format} ${frame.width}x${frame.height}`);
    this.counts.age.title = `since the ${frame.moment}`;
    this.account(account);
    this.age();
  }

  account(account) {
    this.accounts.push(account);
    while (this.accounts.length > 2 && account.at - this.accounts[0].at > WINDOW_S) this.accounts.shift();
    const [first] = this.accounts;
    const seconds = account.at - first.at;
    for (const [key, name] of [["shown", "delivered"], ["camera", "offered"]]) {
      if (seconds > 0) this.count(key, `${((account[name] - first[name]) / seconds).toFixed(1)}/s`);
    }
    this.count("skipped", String(account.skipped));
    this.count("lost", account.bad ? `${account.lost}, ${account.bad} not readable` : String(account.lost));
    this.counts.lost.classList.toggle("warn", account.lost + account.bad > 0);
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
    const [first, last] = [this.accounts[0], this.accounts.at(-1)];
    const count = last ? last.offered - first.offered : 0;
    return count ? (last.at - first.at) / count : 0;
  }
}

// ---------------------------------------------------------------------- all of them

function live(mode, text) {
  $("live").dataset.state = mode;
  setText("live", text);
}

// Ask what sources there are, and connect to those that are not connected.
let looking = false;
async function look() {
  if (looking || document.hidden) return;
  looking = true;
  try {
    const response = await fetch("/api/sources", { headers: token ? { Authorization: `Bearer ${token}` } : {}, cache: "no-store" });
    const answer = await response.json();
    if (response.status === 401) return askToken(answer);
    if (!response.ok) throw new Error(answer.error);
    arrange(answer.sources);
    for (const one of sources) one.connect();
    reached = true;
    $("alarm").hidden = true;
    live("live", "live");
  } catch {
    reached = false;
    $("alarm").hidden = false;
    setText("alarm", "The page's server does not answer. Is smartcam frames show still running?");
    live("lost", "no server");
    setTimeout(look, 1000);
  } finally {
    looking = false;
  }
}

function arrange(told) {
  if (told.length !== sources.length || told.some(({ name }, index) => sources[index].title.textContent !== name)) {
    for (const one of sources) one.disconnect();
    sources = told.map((one) => new Source(one));
    $("main").replaceChildren(...sources.map((one) => one.panel));
    $("main").dataset.count = String(sources.length);
  }
  setText("name", told.map(({ name }) => name).join(", "));
  $("main").hidden = false;
  $("gate").hidden = true;
}

function askToken(answer) {
  $("main").hidden = $("alarm").hidden = true;
  $("gate").hidden = false;
  $("gate-error").textContent = token ? `Refused: ${answer.came}` : "";
  live("lost", "token needed");
}

$("gate").addEventListener("submit", (event) => {
  event.preventDefault();
  token = $("token").value.trim();
  sessionStorage.setItem("smartcam-token", token);
  $("gate").hidden = true;
  look();
});

document.addEventListener("visibilitychange", () => {
  if (!document.hidden) return look();
  for (const one of sources) {
    one.disconnect();
    one.told("wait", "");
    one.state.textContent = "paused";
  }
});

const given = new URLSearchParams(location.hash.slice(1)).get("token");
if (given) sessionStorage.setItem("smartcam-token", given);
token = sessionStorage.getItem("smartcam-token");
history.replaceState(null, "", location.pathname);
setInterval(() => sources.forEach((one) => one.age()), 250);
look();
