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
