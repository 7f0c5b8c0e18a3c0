// What the pages that follow a camera have in common.

export const $ = (id) => document.getElementById(id);
export const SILENT_MS = 6000; // a stream tells its clock once a second
const SVG = "http://www.w3.org/2000/svg";

// Status bits: what they are called, and what they are.
export const BITS = [
  ["RUNNING", "Running", "good"],
  ["WAITING_FOR_TRIGGER", "Waiting for trigger", "good"],
  ["BUSY", "Busy", "warn"],
  ["OVERTRIGGERED", "Overtriggered", "warn"],
  ["INPUT_CONTAINER", "Input container", "warn"],
  ["OVERHEAT", "Overheat", "bad"],
  ["SYSTEM_ERROR", "System error", "bad"],
];

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key in element && key !== "list" && key !== "form") element[key] = value;
    else if (value !== null && value !== undefined) element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

export function draw(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

export function setText(id, text) {
  const element = $(id);
  if (element && element.textContent !== text) element.textContent = text;
}

// ---------------------------------------------------------------------- the token

const TOKEN = "smartcam-token"; // in the tab's memory

export const token = () => sessionStorage.getItem(TOKEN);
export const headers = () => (token() ? { Authorization: `Bearer ${token()}` } : {});

export class Refused extends Error {
  constructor(status, answer) {
    super(answer.received ?? `HTTP ${status}`);
    this.status = status;
    this.answer = answer;
  }
}

export async function call(path, body) {
  const more = body ? { "Content-Type": "application/json" } : {};
  const response = await fetch(path, { method: body ? "POST" : "GET", headers: { ...headers(), ...more }, cache: "no-store", body: body && JSON.stringify(body) });
  if (response.ok) return response;
  throw new Refused(response.status, await response.json());
}

// Take the token out of the address, and go on whenever one was entered at the gate.
export function atGate(goOn) {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) sessionStorage.setItem(TOKEN, given);
  history.replaceState(null, "", location.pathname);
  $("gate").addEventListener("submit", (event) => {
    event.preventDefault();
    sessionStorage.setItem(TOKEN, $("token").value.trim());
    $("gate").hidden = true;
    goOn();
  });
}

// Ask for the token in place of all else; answer: why the server refused.
export function askToken(answer) {
  $("main").hidden = $("alarm").hidden = true;
  $("gate").hidden = false;
  $("gate-error").textContent = token() ? `Refused: ${answer.received}` : "";
  live("lost", "token needed");
}

export function live(mode, text) {
  $("live").dataset.state = mode;
  setText("live", text);
}

// ---------------------------------------------------------------------- units

const UNITS = "smartcam-units"; // in the browser's memory, for all pages of this server
let instead = {}; // what is shown instead of an SI unit: name and factor

// Take the units of the server; the switch stands as this browser left it, else as the server says.
export function takeUnits(units, changed) {
  if (JSON.stringify(units.instead) === JSON.stringify(instead)) return;
  instead = units.instead;
  const chosen = localStorage.getItem(UNITS);
  $("practical").checked = chosen === null ? units.shown_first : chosen === "true";
  setText("practical-names", Object.values(instead).map(([name]) => name).join(", "));
  $("practical").onchange = () => {
    localStorage.setItem(UNITS, String($("practical").checked));
    changed();
  };
}

export const isPractical = () => $("practical").checked;
export const shownUnit = (unit) => (isPractical() && instead[unit]) || [unit, 1];

// A moment as people read it: the time, and the day where that is not today.
export function clock(seconds) {
  const at = new Date(1000 * seconds);
  const time = at.toLocaleTimeString([], { hour12: false });
  return at.toDateString() === new Date().toDateString() ? time : `${at.toLocaleDateString([], { day: "numeric", month: "short" })} ${time}`;
}

// Since when something is so; `seen`: whether it was seen to begin.
export const since = (seconds, seen) => `${seen ? "since" : "at least since"} ${clock(seconds)}`;

// The events of a stream, as they come.
export async function* events(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const parts = (rest + value).split("\n\n");
    rest = parts.pop();
    for (const part of parts) {
      const lines = part.split("\n").map((line) => [line.slice(0, line.indexOf(": ")), line.slice(line.indexOf(": ") + 2)]);
      const { event: kind, data, id } = Object.fromEntries(lines);
      yield { kind, id, data: JSON.parse(data) };
    }
  }
}
