// A row of the fleet's page: one camera.

import { draw, make } from "./base.js";

const MODES = { // what is said of a camera, with a sign that tells it without colours
  running: ["●", "running", "good"],
  busy: ["◐", "busy", "warn"],
  stopped: ["■", "stopped", "warn"],
  awaited: ["…", "not reached yet", "bad"],
  lost: ["▲", "lost", "bad"],
  ended: ["▲", "given up", "bad"],
  gone: ["○", "no agent has it", "bad"],
  error: ["▲", "error", "bad"],
};
const OUTCOMES = { passed: "✓ pass", failed: "✗ fail" };
const SIGNS = { passed: "✓", failed: "✗" };
const [WIDTH, HEIGHT, EDGE] = [82, 46, 4]; // pixels of a picture

let count = 0;

const text = (element, value) => element.textContent !== value && (element.textContent = value);

export class Row {
  constructor(name) {
    count += 1;
    this.name = name;
    this.last = null;
    this.link = make("a", { href: `/camera/${name.split("/").map(encodeURIComponent).join("/")}`, textContent: name, tabIndex: -1, draggable: false });
    this.agents = make("small");
    this.mode = make("b");
    this.reason = make("small");
    this.said = make("span");
    this.when = make("small");
    const cell = (className, ...children) => make("div", { className, role: "gridcell" }, ...children);
    this.picture = cell("picture");
    this.rate = cell("number rate");
    this.count = cell("number count");
    this.errors = cell("number errors-count");
    this.element = make("div", { className: "camera", role: "row", id: `camera-${count}`, "data-camera": name },
      this.picture, cell("called", this.link, this.agents), cell("state", this.mode, this.reason), cell("last", this.said, this.when), this.rate, this.count, this.errors);
    this.element.addEventListener("click", (event) => event.target !== this.link && this.open());
  }

  open() {
    this.link.click();
  }

  // Stand at this place of the table.
  put(index, high) {
    const top = `${index * high}px`;
    if (this.element.style.top !== top) this.element.style.top = top;
    this.element.setAttribute("aria-rowindex", index + 2);
  }

  choose(on) {
    this.element.dataset.chosen = String(on);
  }

  show(one, outlines, now) {
    const [sign, word, tone] = MODES[one.mode] ?? ["?", one.mode, "warn"];
    Object.assign(this.element.dataset, { mode: one.mode, tone });
    text(this.agents, one.agents.join(", "));
    text(this.mode, `${sign} ${word}`);
    const application = one.application === null ? "" : `application ${one.application}`;
    text(this.reason, one.reason || application);
    this.reason.title = one.reason;
    text(this.rate, one.rate ? `${one.rate.toLocaleString("en")}/s` : "");
    text(this.count, one.count.toLocaleString("en"));
    text(this.errors, one.errors ? one.errors.toLocaleString("en") : "");
    this.errors.classList.toggle("wrong", one.errors > 0);
    if (one.last && one.last.at !== this.last?.at) this.picture.replaceChildren(picture(one.last, outlines));
    this.last = one.last;
    this.said.className = one.last ? `said-${one.last.outcome}` : "";
    text(this.said, one.last ? says(one.last) : "");
    this.said.title = this.said.textContent;
    this.age(now);
  }

  age(now) {
    if (this.last) text(this.when, ago(Math.max(0, now - this.last.at)));
  }
}

function says(last) {
  const outcome = OUTCOMES[last.outcome] ? `${OUTCOMES[last.outcome]} · ` : "";
  if (last.parts === undefined) return outcome + last.text;
  if (!last.parts_count) return "no part";
  return `${last.parts_count} ${last.parts_count === 1 ? "part" : "parts"}: ${last.parts.slice(0, 3).map(([name]) => name).join(", ")}${last.parts_count > 3 ? " …" : ""}`;
}

function ago(seconds) {
  if (seconds < 2) return "now";
  if (seconds < 120) return `${Math.floor(seconds)} s ago`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min ago` : `${Math.floor(seconds / 3600)} h ago`;
}

// The outlines of a result's parts from above, or a sign where it has none.
function picture(last, outlines) {
  const svg = draw("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": says(last) });
  if (!last.parts?.length) {
    svg.append(draw("text", { class: `sign ${last.outcome}`, x: WIDTH / 2, y: HEIGHT / 2 + 7, "text-anchor": "middle" }, SIGNS[last.outcome] ?? "–"));
    return svg;
  }
  const names = Object.keys(outlines);
  const shapes = last.parts.map(([name, x, y, theta]) => ({ name, corners: turned(outlines[name] ?? [], x, y, theta), at: [x, y] }));
  const all = shapes.flatMap(({ corners, at }) => (corners.length ? corners : [at]));
  const span = (axis) => [Math.min(...all.map((one) => one[axis])), Math.max(...all.map((one) => one[axis]))];
  const [[left, right], [bottom, top]] = [span(0), span(1)];
  const size = Math.max(0.02, right - left, ((top - bottom) * WIDTH) / HEIGHT);
  const scale = (WIDTH - 2 * EDGE) / size;
  const place = ([x, y]) => [WIDTH / 2 + (x - (left + right) / 2) * scale, HEIGHT / 2 - (y - (bottom + top) / 2) * scale * 0.98];
  for (const { name, corners, at } of shapes) {
    const colour = names.includes(name) ? `p${names.indexOf(name) % 7}` : "plain";
    if (corners.length) svg.append(draw("polygon", { class: colour, "data-part": name, points: corners.map((one) => place(one).map((each) => each.toFixed(1)).join(",")).join(" ") }));
    else svg.append(draw("circle", { class: colour, "data-part": name, cx: place(at)[0].toFixed(1), cy: place(at)[1].toFixed(1), r: 3.5 }));
  }
  return svg;
}

function turned(outline, x, y, theta) {
  const [sin, cos] = [Math.sin(theta), Math.cos(theta)];
  return outline.map(([a, b]) => [x + a * cos - b * sin, y + a * sin + b * cos]);
}
