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
  $("gate-error").textContent = token() ? `Refused: ${answer.came}` : "";
  live("lost", "token needed");
}

export function live(mode, text) {
  $("live").dataset.state = mode;
  setText("live", text);
}

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
