// A row of the fleet's page: one camera.

import { clock, draw, isPractical, make, since } from "./base.js";

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
const [SLOTS, SLOT_S, SLOT, HIGH] = [20, 1800, 5, 26]; // places of the trend, seconds and pixels of one

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
    this.trend = cell("trend");
    this.failing = null; // since when, and how often
    this.element = make("div", { className: "camera", role: "row", id: `camera-${count}`, "data-camera": name },
      this.picture, cell("called", this.link, this.agents), cell("state", this.mode, this.reason), cell("last", this.said, this.when), this.rate, this.count, this.errors, this.trend);
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
    const application = one.application === null ? "" : one.application < 0 ? "application without an id" : `application ${one.application}`;
    const when = tone === "bad" && one.mode !== "error" ? since(one.changed_at, one.changed_at_exact) : "";
    text(this.reason, [when, one.reason || (when ? "" : application)].filter(Boolean).join(": "));
    this.reason.title = this.reason.textContent;
    text(this.rate, one.rate ? `${one.rate.toLocaleString("en")}/s` : "");
    text(this.count, one.count.toLocaleString("en"));
    text(this.errors, one.errors ? one.errors.toLocaleString("en") : "");
    this.errors.classList.toggle("wrong", one.errors > 0);
    if (one.last && one.last.at !== this.last?.at) this.picture.replaceChildren(picture(one.last, outlines));
    this.trend.replaceChildren(trend(one, now));
    this.last = one.last;
    this.failing = one.failed_since ? `fails since ${clock(one.failed_since)}, ${one.in_a_row.toLocaleString("en")} in a row · ` : "";
    this.said.className = one.last ? `said-${one.last.outcome}` : "";
    text(this.said, one.last ? says(one.last) : "");
    this.said.title = this.said.textContent;
    this.age(now);
  }

  age(now) {
    if (this.last) text(this.when, `${this.failing}${ago(Math.max(0, now - this.last.at))}`);
  }
}

function says(last) {
  const outcome = OUTCOMES[last.outcome] ? `${OUTCOMES[last.outcome]} · ` : "";
  if (last.parts === undefined) return outcome + ((isPractical() && last.practical) || last.text);
  if (!last.parts_count) return "no part";
  return `${last.parts_count} ${last.parts_count === 1 ? "part" : "parts"}: ${last.parts.slice(0, 3).map(([name]) => name).join(", ")}${last.parts_count > 3 ? " …" : ""}`;
}

// The outcomes of ten hours, half an hour each: how many of those with a verdict were bad.
function trend({ shift, trend: { end, characters } }, now) {
  const counts = shift.map((count, index) => `${count.toLocaleString("en")} ${["passed", "failed", "without a verdict", "errors"][index]}`);
  const svg = draw("svg", { viewBox: `0 0 ${SLOTS * SLOT} ${HIGH}`, role: "img", "aria-label": `Last ten hours: ${counts.join(", ")}` }, draw("title", {}, counts.join(", ")));
  svg.append(draw("line", { class: "rule", x1: 0, x2: SLOTS * SLOT, y1: HIGH - 0.5, y2: HIGH - 0.5 }));
  const late = Math.max(0, Math.ceil((now - end) / SLOT_S)); // places that have gone by since
  [...characters].forEach((character, index) => {
    const x = (SLOTS - late - characters.length + index) * SLOT;
    if (character === " " || x < 0) return;
    const bar = (kind, y, high) => high > 0 && svg.append(draw("rect", { class: kind, x, y, width: SLOT - 1, height: high }));
    if (character === "-") return bar("other", HIGH / 2, HIGH / 2);
    const bad = ((character === "X" ? 10 : Number(character)) / 10) * HIGH;
    bar("passed", bad, HIGH - bad);
    bar("failed", 0, bad);
  });
  return svg;
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
