// The live page: shows what a camera sends. Everything it does is one of the HTTP calls of GET /api.

import { $, BITS, SILENT_MS, askToken, atGate, clock, draw, events, headers, live, make, setText, shownUnit, since, takeUnits } from "./base.js";
import { Source } from "./pictures.js";

const MAX_ROWS = 100; // results in the document
const OLD_S = 10; // a result of before is called old
const SERIES = 300; // seconds that the plots show
const MM = 1000;

// One camera of a fleet has a page of its own; its calls stand under its name.
const FLEETS = location.pathname.startsWith("/camera/");
const CALLED = decodeURIComponent(location.pathname.slice("/camera/".length));
const API = FLEETS ? `/api/cameras/${encodeURIComponent(CALLED)}` : "/api";
const SERVED = FLEETS ? "smartcam fleet page" : "smartcam live";

let unknown = ""; // why there is no such camera
let state = null; // the camera, as its events tell it
let reached = false; // whether the page's own server answers
let results = []; // the newest first
let missed = 0;
let series = [];
let view = null; // what the drawing shows, metres
let offset = 0; // seconds that this machine's clock is ahead of the server's

// ---------------------------------------------------------------------- calls

async function ask(path, options = {}) {
  const response = await fetch(path, { ...options, headers: { ...headers(), ...options.headers }, cache: "no-store" });
  if (response.ok) return response;
  const answer = await response.json();
  if (response.status === 401) askToken(answer);
  throw Object.assign(new Error(answer.expected ? `${answer.received}; expected ${answer.expected}` : answer.error), { status: response.status });
}

async function act(what, path, body) {
  const options = { method: "POST" };
  if (body !== undefined) Object.assign(options, { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  try {
    await ask(path, options);
    if (what) tell(what);
  } catch (error) {
    tell(error.message, true);
  }
}

function tell(text, bad = false) {
  const box = make("div", { className: bad ? "bad" : "", textContent: text });
  $("told").replaceChildren(box);
  setTimeout(() => box.remove(), bad ? 9000 : 3500);
}

// ---------------------------------------------------------------------- the event stream

async function listen() {
  let last = null; // the stream's last event with an id
  let pause = 300;
  for (;;) {
    const quiet = new AbortController();
    const stop = () => quiet.abort();
    let watchdog = setTimeout(stop, SILENT_MS);
    try {
      const more = last === null ? {} : { "Last-Event-ID": last };
      const response = await ask(`${API}/events`, { headers: more, signal: quiet.signal });
      for await (const event of events(response.body)) {
        clearTimeout(watchdog);
        watchdog = setTimeout(stop, SILENT_MS);
        pause = 300;
        [reached, unknown] = [true, ""];
        last = event.id ?? last;
        TAKE[event.kind]?.(event.data);
        showAlarm();
      }
    } catch (error) {
      if (error.status === 401) return;
      unknown = error.status ? error.message : "";
    } finally {
      clearTimeout(watchdog);
    }
    reached = false;
    showAlarm();
    await new Promise((done) => setTimeout(done, pause));
    pause = Math.min(3000, pause * 2);
  }
}

const TAKE = { camera: takeState, results: takeResults, counts: showCounts, picture: takePicture, clock: takeClock, history: takeHistory };

// ---------------------------------------------------------------------- how it is

const CONNECTIONS = {
  connected: ["running", "connected"],
  awaited: ["switching", "not reached yet"],
  lost: ["rebooting", "lost, trying again"],
  taken: ["rebooting", "taken by another client"],
  ended: ["rebooting", "given up"],
};

function takeState(value) {
  state = value;
  $("main").hidden = false;
  document.title = `${state.name} · smartcam live`;
  setText("name", state.name);
  setText("url", state.url);
  const [mode, text] = CONNECTIONS[state.connection];
  setText("mode", text);
  $("mode").dataset.mode = mode;
  const rows = BITS.map(([name, label, tone]) => {
    const on = state.status.includes(name);
    return make("li", { className: tone, "data-on": String(on), "data-bit": name, textContent: label, "aria-label": `${label}: ${on ? "set" : "not set"}` });
  });
  $("status").replaceChildren(...rows);
  const can = state.capabilities ?? {};
  const facts = {
    Application: state.application < 0 ? "without an id" : (state.application ?? "not known yet"),
    Speaks: can.dialect ?? "not known yet",
    [state.connection === "connected" ? "Connected" : "Not connected"]: since(state.changed_at, state.changed_at_exact),
  };
  $("facts").replaceChildren(...list(facts));
  takeUnits(state.units, showUnits);
  showControls(can);
  takeFrames();
  $("image-panel").hidden = !can.read_image;
  if (can.read_image) setText("image-note", state.picture_error || ($("image").hidden ? "Not fetched yet." : ""));
  arrange();
}

const list = (facts) => Object.entries(facts).flatMap(([name, value]) => [make("dt", { textContent: name }), make("dd", { textContent: String(value) })]);

function showControls(can) {
  const ready = state.connection === "connected";
  $("control").hidden = !state.control;
  for (const [id, able] of [["trigger", true], ["start", can.start_stop], ["stop", can.start_stop]]) $(id).disabled = !(ready && able);
  $("take-back").hidden = !(FLEETS && state.connection === "taken");
  for (const one of $("switch").querySelectorAll("input, button")) one.disabled = !(ready && can.switch);
  if (document.activeElement !== $("application")) $("application").placeholder = state.application < 0 ? "" : (state.application ?? "");
  const mute = can.unasked_results === false && !state.control ? " This camera sends no results by itself." : "";
  setText("looking", `Looking only: --control lets this page trigger and switch.${mute}`);
  $("looking").hidden = state.control;
}

$("trigger").addEventListener("click", () => act("", `${API}/trigger`, {}));
$("start").addEventListener("click", () => act("It runs.", `${API}/start`));
$("stop").addEventListener("click", () => act("It has stopped.", `${API}/stop`));
$("take-back").addEventListener("click", () => act("The agent has it back.", `${API}/take_back`));
$("switch").addEventListener("submit", (event) => {
  event.preventDefault();
  act("Loaded.", `${API}/switch`, { application: $("application").valueAsNumber });
});

// Says in words what is wrong; what is shown is dimmed then, as it is of before.
function showAlarm() {
  let text = "";
  if (unknown) text = `${unknown} It is asked for again.`;
  else if (!reached) text = `This page's server does not answer: ${SERVED} has ended, or the network is gone. What is shown is of before.`;
  else if (state && state.connection !== "connected") {
    const when = since(state.changed_at, state.changed_at_exact);
    const why = state.loss ? ` (${state.loss})` : "";
    const tried = state.last_error && !state.loss.includes(state.last_error) ? ` Last try: ${state.last_error.replace(/\.?$/, ".")}` : "";
    text = {
      awaited: state.loss ? `The camera is not reached yet; it is tried again. ${state.loss}` : "The camera is being connected.",
      lost: `The camera is lost ${when}${why}; it is tried again.${tried} What is shown is of before.`,
      taken: `Another client has the camera ${when}. ${FLEETS ? "Its agent tries again now and then; Take back does it now." : "Start smartcam live again to take it back."}`,
      ended: `The camera is given up ${when}${why}.${FLEETS ? "" : " Start smartcam live again."}`,
    }[state.connection];
  }
  if ($("gate").hidden) $("alarm").hidden = !text;
  setText("alarm", text);
  $("main").classList.toggle("stale", Boolean(text));
  live(reached ? (text ? "wait" : "live") : "lost", reached ? (text ? "no camera" : "live") : "no server");
}

function showAge() {
  const last = results.find((one) => one.error === undefined);
  if (!last) return setText("age", "none yet");
  const age = Math.max(0, Date.now() / 1000 - offset - last.received_at);
  const old = age >= OLD_S || $("main").classList.contains("stale");
  $("age").classList.toggle("old", old);
  setText("age", `${duration(age)} ago${old ? ": not fresh" : ""}`);
}

function duration(seconds) {
  if (seconds < 1) return "less than 1 s";
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

// ---------------------------------------------------------------------- results

function takeResults(value) {
  const first = value.results[0];
  if (first && results.length && first.serial <= results[0].serial) [results, missed] = [[], 0]; // another server's
  missed += value.missed;
  results = [...value.results.reverse(), ...results].slice(0, MAX_ROWS);
  $("rows").replaceChildren(...results.map(makeRow));
  $("none").hidden = results.length > 0;
  setText("missed", [`the last ${results.length}`, missed ? `${missed} more came too fast to be shown` : ""].filter(Boolean).join(" · "));
  showLast();
  showAge();
}

const number = (value) => (Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(5))));

const scaled = (value, unit) => (typeof value === "number" && typeof unit === "string" ? value * shownUnit(unit)[1] : value);

// `units`: the value's own unit, or those of its fields by their names.
function short(value, units = {}) {
  if (value === null || value === undefined) return "none";
  if (value === "") return '""';
  if (Array.isArray(value)) return `${value.length} records${value.length ? ": " : ""}${value.slice(0, 3).map((one) => short(one, units)).join(" | ")}${value.length > 3 ? " …" : ""}`;
  if (typeof value === "object") return Object.entries(value).map(([key, one]) => `${key} ${short(one, units[key])}`).join(", ");
  if (typeof value !== "number") return String(value);
  return typeof units === "string" ? `${number(scaled(value, units))} ${shownUnit(units)[0]}` : number(value);
}

function showUnits() {
  $("rows").replaceChildren(...results.map(makeRow));
  showLast();
}

const WORDS = { pass: "PASS", fail: "FAIL" };
// a badge says PASS or FAIL first, and then of what
const badge = (one) => (one.verdict ? [make("b", { textContent: WORDS[one.verdict] }), ` ${one.name}: ${one.of === 1 ? (one.true ? "true" : "false") : `${one.true} of ${one.of} true`}`] : [one.name, make("b", { textContent: word(one) })]);
const word = ({ true: count, of, verdict }) => (of === 1 ? (WORDS[verdict] ?? (count ? "true" : "false")) : `${verdict ? `${WORDS[verdict]} ` : ""}${count} of ${of} true`);
const mm = (metres) => (metres === null ? "?" : (metres * MM).toFixed(1));
const degrees = (theta) => (theta === null ? "?" : `${((theta * 180) / Math.PI).toFixed(1)}°`);

function says(one) {
  if (one.error !== undefined) return `not readable: ${one.error}`;
  if (one.parts) return one.count ? `${one.count} ${one.count === 1 ? "part" : "parts"}: ${one.parts.slice(0, 4).map((part) => `${part.name} ${mm(part.x)}, ${mm(part.y)} mm, ${degrees(part.theta)}`).join(" | ")}${one.count > 4 ? " …" : ""}` : "no part";
  if (one.cut !== undefined) return `${one.cut} … (${one.size} bytes, too long for this page)`;
  const text = short(one.value, one.units);
  return text.length > 300 ? `${text.slice(0, 300)} …` : text;
}

function makeRow(one) {
  const cells = one.error === undefined
    ? [one.number, clock(one.received_at), one.latency === null ? "" : `${(one.latency * MM).toFixed(1)} ms`, one.application < 0 ? "" : (one.application ?? "")]
    : ["", "", "", ""];
  const judged = (one.verdicts ?? []).filter((each) => each.verdict);
  const marks = judged.map((each) => make("b", { "data-verdict": each.verdict, className: "badge", textContent: judged.length > 1 ? `${WORDS[each.verdict]}: ${each.name}` : WORDS[each.verdict] }));
  return make("tr", { className: one.error === undefined ? "" : "marked", "data-serial": one.serial },
    ...cells.map((text, index) => make("td", { className: index ? "" : "time", textContent: String(text) })), make("td", {}, ...marks, says(one)));
}

function showLast() {
  const last = results[0];
  if (!last) return;
  $("verdicts").replaceChildren(...(last.verdicts ?? []).map((one) =>
    make("span", { "data-verdict": one.verdict ?? "", "data-name": one.name }, ...badge(one))));
  $("last").replaceChildren(makeValue(last));
  $("units").hidden = !results.some((one) => Object.keys(one.units ?? {}).length);
  if (results.some((one) => one.parts?.length)) {
    $("scene-panel").hidden = false;
    arrange();
    drawParts();
  }
}

function makeValue(one) {
  if (one.error !== undefined) return make("p", { className: "error", textContent: says(one) });
  if (one.parts) return makeTable(one.parts.slice(0, 20).map((part) => ({ part: part.name, "x, mm": mm(part.x), "y, mm": mm(part.y), ...(one.parts.some((each) => each.z) ? { "z, mm": mm(part.z) } : {}), θ: degrees(part.theta), quality: part.quality === null ? "" : part.quality.toFixed(3) })), one.count, "No part was found.");
  const { value } = one;
  if (Array.isArray(value) && value.every((each) => each !== null && typeof each === "object" && !Array.isArray(each))) return makeTable(value.slice(0, 20), value.length, "No record.", one.units);
  if (value !== null && typeof value === "object" && !Array.isArray(value)) return make("dl", {}, ...list(Object.fromEntries(Object.entries(value).map(([key, each]) => [key, short(each, one.units[key])]))));
  return make("code", { textContent: says(one) });
}

function makeTable(rows, count, none, units = {}) {
  if (!count) return make("p", { textContent: none });
  const names = Object.keys(rows[0]);
  const table = make("table", {}, make("thead", {}, make("tr", {}, ...names.map((name) => make("th", { scope: "col", textContent: typeof units[name] === "string" ? `${name}, ${shownUnit(units[name])[0]}` : name })))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...names.map((name) => make("td", { textContent: short(scaled(row[name], units[name]), typeof units[name] === "string" ? {} : units[name]) }))))));
  return make("div", {}, table, ...(count > rows.length ? [make("p", { className: "note", textContent: `and ${count - rows.length} more` })] : []));
}

// ---------------------------------------------------------------------- parts

// The lengths 1, 2, 5, 10 ... mm: the first that is not below this one.
function round(length) {
  const decade = 10 ** Math.floor(Math.log10(length));
  return decade * [1, 2, 5, 10].find((one) => one * decade >= length * 0.999);
}

const drawable = (one) => (one.parts ?? []).filter((part) => part.x !== null && part.y !== null);

// What is shown grows with what comes, and shrinks only when it is four times too large.
function fit() {
  const all = results.flatMap(drawable);
  const span = (of) => [Math.min(...all.map(of)), Math.max(...all.map(of))];
  const [left, right] = span((part) => part.x * MM);
  const [bottom, top] = span((part) => part.y * MM);
  const edge = Math.max(20, 0.15 * Math.max(right - left, top - bottom));
  const wanted = { left: left - edge, right: right + edge, bottom: bottom - edge, top: top + edge };
  const inside = view && view.left <= left && view.right >= right && view.bottom <= bottom && view.top >= top;
  if (!inside || view.right - view.left > 4 * (wanted.right - wanted.left)) view = wanted;
}

function drawParts() {
  const svg = $("parts");
  const { clientWidth: width, clientHeight: height } = svg;
  if (!width || !results.some((one) => drawable(one).length)) return;
  fit();
  const head = 36; // pixels, for the scale
  const scale = Math.min(width / (view.right - view.left), (height - head) / (view.top - view.bottom)); // pixels per mm
  const middle = [(view.left + view.right) / 2, (view.bottom + view.top) / 2];
  const at = (x, y) => [width / 2 + (x - middle[0]) * scale, (height + head) / 2 - (y - middle[1]) * scale];
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const step = round(70 / scale);
  const drawn = [];
  const [left, right] = [middle[0] - width / 2 / scale, middle[0] + width / 2 / scale];
  const [bottom, top] = [middle[1] - height / scale, middle[1] + height / scale];
  for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
    const [px] = at(x, 0);
    drawn.push(draw("line", { class: Math.abs(x) < step / 2 ? "axis" : "rule", x1: px, x2: px, y1: 0, y2: height }));
    if (px > 60 && px < width - 20) drawn.push(draw("text", { x: px + 3, y: height - 6 }, number(x)));
  }
  for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
    const [, py] = at(0, y);
    drawn.push(draw("line", { class: Math.abs(y) < step / 2 ? "axis" : "rule", x1: 0, x2: width, y1: py, y2: py }));
    if (py > head && py < height - 24) drawn.push(draw("text", { x: 5, y: py - 3 }, number(y)));
  }
  const last = results.find((one) => one.error === undefined) ?? {};
  const taken = drawable(last).flatMap(({ x, y, theta }) => { // what names keep clear of: parts and their arrows
    const centre = at(x * MM, y * MM);
    return [box(centre, -10, -10, 20, 20), box(centre, 18 * Math.cos(theta) - 6, -18 * Math.sin(theta) - 6, 12, 12)];
  });
  for (const part of drawable(last)) drawn.push(drawPart(part, at(part.x * MM, part.y * MM), width, taken));
  const length = step * scale;
  drawn.push(draw("line", { class: "bar", x1: width - 12 - length, x2: width - 12, y1: 14, y2: 14 }));
  drawn.push(draw("text", { x: width - 12 - length / 2, y: 30, "text-anchor": "middle", "data-scale": step }, `${number(step)} mm`));
  svg.replaceChildren(...drawn);
  setText("frame", last.frame ? `mm, in the frame of ${last.frame}; x right, y up` : "mm; x right, y up");
}

const box = ([x, y], left, top, width, height) => ({ left: x + left, top: y + top, right: x + left + width, bottom: y + top + height });
const meets = (one, other) => one.left < other.right && other.left < one.right && one.top < other.bottom && other.top < one.bottom;

// Where a name stands beside its part: the first of some places that is free, or the first.
function nameAt(name, at, width, taken) {
  const long = 7 * name.length;
  const places = [[14, -24], [-14 - long, -24], [14, 10], [-14 - long, 10], [-long / 2, -38], [-long / 2, 24]].map(([left, top]) => box(at, left, top, long, 15));
  const inside = places.filter((one) => one.left >= 0 && one.right <= width);
  const found = inside.find((one) => !taken.some((other) => meets(one, other))) ?? inside[0] ?? places[0];
  taken.push(found);
  return { x: found.left, y: found.top + 12 };
}

function drawPart(part, [x, y], width, taken) {
  const label = `${part.name}: x ${mm(part.x)} mm, y ${mm(part.y)} mm, ${degrees(part.theta)}`;
  const turned = part.theta === null ? 0 : (-part.theta * 180) / Math.PI;
  return draw("g", { class: "found", "data-part": part.name }, draw("title", {}, label),
    draw("g", { transform: `translate(${x} ${y}) rotate(${turned})` },
      draw("circle", { class: "body", r: 9 }), draw("path", { class: "arrow", d: "M0 0H24M18 -5L24 0L18 5M0 -6V6" })),
    draw("text", { class: "called", ...nameAt(part.name, [x, y], width, taken) }, part.name));
}

function arrange() {
  const shown = [$("scene-panel"), $("image-panel")].filter((one) => !one.hidden).length;
  $("main").classList.toggle("plain", shown === 0);
  $("main").classList.toggle("both", shown === 2);
  $("main").classList.toggle("seeing", frames !== null);
}

// ---------------------------------------------------------------------- frames

let frames = null; // the newest frame of a camera that has some

function takeFrames() {
  if (state.frames === Boolean(frames)) return;
  if (frames) {
    frames.end();
    frames.panel.remove();
    frames = null;
    return;
  }
  frames = new Source({ name: "What the camera sees", path: `${API}/frames` });
  frames.view.addEventListener("click", enlarge);
  $("main").append(frames.panel);
}

function enlarge() {
  const large = frames?.panel.classList.toggle("large") ?? false;
  frames?.view.setAttribute("aria-pressed", String(large));
}

document.addEventListener("keydown", ({ key }) => key === "Escape" && frames?.panel.classList.contains("large") && enlarge());
setInterval(() => frames?.age(), 250);

// ---------------------------------------------------------------------- picture

let fetching = false;
let shown = 0; // serial of the picture
let newest = 0;

async function takePicture({ serial }) {
  newest = serial;
  if (fetching) return;
  fetching = true;
  try {
    while (newest && newest !== shown) {
      const wanted = newest;
      $("image").src = await pictureAt(`${API}/picture`);
      $("image").hidden = false;
      shown = wanted;
      setText("image-note", `Fetched at ${clock(Date.now() / 1000)}.`);
    }
  } catch (error) {
    setText("image-note", error.message);
  }
  fetching = false;
}

// The page may show data: but no blob:, which the server's policy forbids.
async function pictureAt(path) {
  const data = await (await ask(path)).blob();
  return new Promise((done, failed) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.onerror = failed;
    reader.readAsDataURL(data);
  });
}

$("fetch").addEventListener("click", () => act("", `${API}/picture`));

// ---------------------------------------------------------------------- counts and plots

const FATES = [
  ["triggered", "answers to a trigger of ours"],
  ["streamed", "sent by itself"],
  ["late", "after its trigger had given up"],
  ["wrong_application", "of another application"],
  ["uninterpretable", "not readable"],
  ["unclaimed", "nobody listened"],
];
const BESIDE = [["inspections_by_others", "triggered by others"], ["overtriggers", "overtriggered"], ["reconnects", "reconnects"], ["not_shown", "too fast for this page"]];

function showCounts(counts) {
  const row = ([name, label], sign) => [make("dt", { textContent: `${sign}${label}` }), make("dd", { "data-count": name, textContent: String(counts[name]) })];
  $("counts").replaceChildren(...row(["received", "received"], ""), ...FATES.flatMap((one, index) => row(one, index ? "+ " : "= ")), ...BESIDE.flatMap((one) => row(one, "")));
  const sum = FATES.reduce((total, [name]) => total + counts[name], 0);
  setText("sum", sum === counts.received ? "adds up" : `does not add up: ${sum} of ${counts.received}`);
}

function takeClock(value) {
  series = value.series.length > 1 ? value.series : [...series, ...value.series];
  series = series.slice(-SERIES);
  const last = series.at(-1);
  if (!last) return;
  if (value.series.length) offset = Date.now() / 1000 - last.at;
  setText("rate-now", number(last.rate));
  const told = series.filter((one) => one.latency !== null).at(-1);
  setText("latency-now", told ? (told.latency * MM).toFixed(1) : "");
  plot("rate", series.map((one) => [one.at, one.rate]));
  plot("latency", series.filter((one) => one.latency !== null).map((one) => [one.at, one.latency * MM]));
}

function plot(id, points) {
  const svg = $(id);
  const { clientWidth: width, clientHeight: height } = svg;
  if (!width) return;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const most = round(Math.max(1, ...points.map(([, y]) => y)));
  const end = series.at(-1).at;
  const [left, top, low] = [34, 8, height - 16];
  const at = ([x, y]) => [left + (1 + (x - end) / SERIES) * (width - left - 4), low - (y / most) * (low - top)];
  const drawn = [];
  for (const y of [0, most / 2, most]) {
    const py = at([end, y])[1];
    drawn.push(draw("line", { class: "rule", x1: left, x2: width, y1: py, y2: py }), draw("text", { x: left - 4, y: py + 3, "text-anchor": "end" }, number(y)));
  }
  for (const [minutes, anchor] of [[5, "start"], [2.5, "middle"], [0, "end"]]) drawn.push(draw("text", { x: at([end - 60 * minutes, 0])[0], y: height - 3, "text-anchor": anchor }, minutes ? `−${minutes} min` : "now"));
  const visible = points.map(at);
  drawn.push(draw("path", { d: visible.map(([x, y], index) => `${index && points[index][0] - points[index - 1][0] < 3 ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("") }));
  if (visible.length) drawn.push(draw("circle", { cx: visible.at(-1)[0], cy: visible.at(-1)[1], r: 2.5 }));
  svg.replaceChildren(...drawn);
}

// ---------------------------------------------------------------------- the shift

const KINDS = ["passed", "failed", "no verdict", "errors"]; // of a bar, behind its time
const BAR_S = 300;
const SHIFT_S = 36000; // seconds that the trend shows

function takeHistory({ bars: told, failures, failed, failed_since: begin, in_a_row: row }) {
  const bars = told.filter(([at]) => at > Date.now() / 1000 - offset - SHIFT_S);
  setText("failed-since", begin ? `fails since ${clock(begin)}, ${row} in a row` : failed ? `${failed} failed; the last one that tells has passed` : bars.length ? "nothing has failed" : "");
  $("failed-since").classList.toggle("bad", Boolean(begin));
  drawTrend(bars);
  const counts = KINDS.map((_, index) => bars.reduce((sum, bar) => sum + bar[index + 1], 0));
  const totals = KINDS.map((kind, index) => `${counts[index]} ${counts[index] === 1 ? kind.replace(/errors$/, "error") : kind}`);
  setText("trend-legend", bars.length ? totals.join(" · ") : "");
  $("trend").setAttribute("aria-label", `Last ten hours: ${totals.join(", ")}`);
  $("failures").hidden = !failures.length;
  $("failures").querySelector("tbody").replaceChildren(...[...failures].reverse().map(failureRow));
}

function failureRow(one) {
  const picture = one.picture ? [make("button", { type: "button", className: "quiet", textContent: "Show", onclick: () => showFailure(one) })] : [];
  const what = one.count > 1 ? `${one.what} (${one.count.toLocaleString("en")} in a row, until ${clock(one.until)})` : one.what;
  return make("tr", { "data-serial": one.serial }, ...[clock(one.at), one.number ?? "", what].map((text) => make("td", { textContent: String(text) })), make("td", {}, ...picture));
}

async function showFailure({ serial, at, what }) {
  try {
    $("failure").src = await pictureAt(`${API}/failures/${serial}`);
    setText("failure-caption", `The picture of ${clock(at)}: ${what}`);
    $("failure-box").hidden = false;
  } catch (error) {
    tell(error.message, true);
  }
}

function drawTrend(bars) {
  const svg = $("trend");
  const { clientWidth: width, clientHeight: height } = svg;
  if (!width || !bars.length) return;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const end = Math.max(bars.at(-1)[0] + BAR_S, Date.now() / 1000 - offset);
  const span = Math.max(3600, Math.min(SHIFT_S, end - bars[0][0]));
  const most = Math.max(1, ...bars.map((bar) => bar.slice(1).reduce((sum, one) => sum + one, 0)));
  const [left, top, low] = [34, 8, height - 16];
  const x = (at) => left + (1 + (at - end) / span) * (width - left - 4);
  const drawn = [draw("text", { x: left - 4, y: top + 6, "text-anchor": "end" }, number(most)), draw("line", { class: "rule", x1: left, x2: width, y1: low, y2: low })];
  for (const [at, anchor] of [[end - span, "start"], [end, "end"]]) drawn.push(draw("text", { x: x(at), y: height - 3, "text-anchor": anchor }, clock(at).slice(0, -3)));
  for (const [at, passed, failed, other, errors] of bars.filter((bar) => bar[0] >= end - span)) {
    let y = low;
    for (const [kind, many] of [["passed", passed], ["other", other], ["failed", failed], ["errors", errors]]) {
      if (!many) continue;
      const high = Math.max(1, (many / most) * (low - top));
      y -= high;
      drawn.push(draw("rect", { class: `bar-${kind}`, x: x(at).toFixed(1), y: y.toFixed(1), width: Math.max(1, x(at + BAR_S) - x(at) - 0.6).toFixed(1), height: high.toFixed(1) }));
    }
  }
  svg.replaceChildren(...drawn);
}

// ---------------------------------------------------------------------- begin

$("back").hidden = !FLEETS;
if (FLEETS) setText("name", CALLED);
setText("gate-served", SERVED);
atGate(listen);
setInterval(showAge, 500);
addEventListener("resize", drawParts);
listen();
