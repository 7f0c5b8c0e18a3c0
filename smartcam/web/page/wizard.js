// The wizard's page: shows the step that the service tells, and sends back what is answered.
// It knows no step of any wizard: inputs are made from their JSON Schema.

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const WIZARDS = {
  plane: "calibrate by what the camera localizes",
  drift: "check whether it is still true",
  sheet: "calibrate by a picture of a printed sheet",
  "hand-eye": "find where the camera is on the robot, or beside it",
};
let token = null;
let view = null;

// ---------------------------------------------------------------------- calls

async function call(method, path, body) {
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  const options = { method, headers };
  if (body !== undefined) {
    headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  let response;
  try {
    response = await fetch(`/api${path}`, options);
  } catch {
    throw new Error("No answer. Nothing is lost: press again.");
  }
  const answer = await response.json();
  if (response.status === 401) {
    showGate(answer);
    throw new Error(answer.error);
  }
  if (!response.ok) throw Object.assign(new Error(answer.error), { status: response.status });
  return answer;
}

function showGate(answer) {
  $("gate-error").textContent = token ? `Refused: ${answer.received}` : "";
  $("main").hidden = true;
  $("gate").hidden = false;
}

// ---------------------------------------------------------------------- steps

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

function input(name, schema, value, error) {
  const wrong = make("span", { class: "error", id: `error-${name}` }, error ?? "");
  const about = { name, id: `input-${name}`, "aria-invalid": error ? "true" : "false", "aria-describedby": wrong.id };
  if (schema.oneOf) {
    const rows = schema.oneOf.map((one) =>
      make("label", { class: "check" },
        make("input", { type: "radio", name, value: one.const, checked: one.const === value }), one.title));
    return make("fieldset", {}, make("legend", {}, schema.title), ...rows, wrong);
  }
  if (schema.type === "boolean") {
    return make("label", { class: "check" }, make("input", { ...about, type: "checkbox", checked: value === true }), schema.title, wrong);
  }
  const unit = schema["x-unit"] ? `, ${schema["x-unit"]}` : "";
  const more = schema.type === "string" ? { maxlength: schema.maxLength } : { inputmode: "decimal" };
  return make("label", {}, `${schema.title}${unit}`,
    make("input", { ...about, ...more, type: "text", autocomplete: "off", value: value ?? "" }), wrong);
}

function answers() {
  const found = {};
  const given = new FormData($("form"));
  for (const [name, schema] of Object.entries(view.schema?.properties ?? {})) {
    const text = (given.get(name) ?? "").toString();
    if (schema.type === "boolean") found[name] = given.has(name);
    else if (schema.type === "string") found[name] = text;
    else if (text.trim() === "") {
      if (schema.type.includes("null")) found[name] = null;
    } else {
      const number = Number(text.replace(",", "."));
      found[name] = Number.isFinite(number) ? number : text; // the service says what is wrong
    }
  }
  return found;
}

// a line of what came out; a warning begins with its code
function note(text) {
  const [, code, rest] = /^([A-Z][A-Z_]+): (.*)$/s.exec(text) ?? [];
  return code ? make("li", { class: "warning" }, make("b", {}, "Warning"), ` ${rest} `, make("code", {}, code)) : make("li", {}, text);
}

const MARKS = { good: "\u2713", poor: "\u2717", unknown: "?" };

function showVerdict(verdict) {
  $("verdict").hidden = !verdict;
  $("verdict").className = verdict?.level ?? "";
  $("verdict").textContent = verdict ? `${MARKS[verdict.level]} ${verdict.text}` : "";
}

const UNITS = { mm: "mm", px: "px", deg: "\u00b0" };
const WORDS = { path: "saved in", good_for_mm: "good for", held_out_mm: "held-out error", left_out: "left out", seen: "points seen", expected_mm: "noise explains", needed: "touches that notice a knock", needed_at: "of the mark of touch" };
const USES = { command: "On the command line", python: "In Python" };

function shown(value, unit) {
  if (Array.isArray(value)) return value.map((one) => shown(one, unit)).join(", ") || "none";
  if (value === null) return "not known";
  if (typeof value === "boolean") return value ? "yes" : "no";
  const text = typeof value !== "number" || Number.isInteger(value) && !unit ? `${value}` : `${Number(value.toFixed(3))}`;
  return unit ? `${text} ${unit}` : text;
}

// what a wizard ends with: figures with the unit that stands in their names, warnings, lines to copy
function showResult({ remarks = [], use = {}, file, ...figures }) {
  $("result").replaceChildren(...Object.entries({ ...(figures.path ? {} : file && { file }), ...figures }).flatMap(([name, value]) => {
    const [, words, unit] = /^(.*?)(?:_(mm|px|deg))?$/.exec(name);
    return [make("dt", {}, WORDS[name] ?? words.replaceAll("_", " ")), make("dd", {}, shown(value, UNITS[unit]))];
  }));
  $("remarks").replaceChildren(...remarks.map((one) => note(Array.isArray(one) ? one.join(": ") : one)));
  $("use").replaceChildren(...Object.entries(use).map(([name, text]) => {
    const copy = make("button", { type: "button" }, "Copy");
    const lines = make("pre", { tabindex: 0 }, make("code", { id: `use-${name}` }, text));
    copy.addEventListener("click", () => copyText(text, copy, lines));
    return make("div", {}, make("h3", {}, USES[name] ?? name, copy), lines);
  }));
}

// a page of another machine may not write to the clipboard: then the lines are marked, to be copied
async function copyText(text, button, lines) {
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren(lines);
    button.textContent = "Marked: press Ctrl+C";
  }
}

function show(next, given) {
  const moved = !view || view.token !== next.token;
  view = next;
  const asking = view.type === "form" || view.type === "confirm" || view.type === "progress";
  $("start").hidden = true;
  $("step").hidden = false;
  $("form").hidden = !asking;
  $("again").hidden = asking;
  $("number").textContent = asking ? counted() : "";
  showResumed(view.resumed);
  $("title").textContent = asking ? view.title : view.type === "result" ? "Done" : "Aborted";
  $("description").textContent = asking ? view.description
    : view.type === "abort" ? "What was measured stands in the journal." : "";
  showVerdict(view.verdict);
  $("notes").replaceChildren(...(view.notes ?? []).map(note));
  $("base").textContent = view.errors.base ?? "";
  showResult(view.result ?? {});
  if (asking) {
    const values = moved ? view.defaults : { ...view.defaults, ...given };
    $("inputs").replaceChildren(...Object.entries(view.schema.properties).map(([name, schema]) =>
      input(name, schema, values[name], view.errors[name])));
    $("go").textContent = view.button;
    for (const what of ["undo", "repeat", "abort"]) $(what).hidden = !view.can.includes(what);
  }
  if (view.type === "progress") $("waiting").textContent = view.waiting;
  draw(view.preview);
  if (view.type === "progress") setTimeout(watch, 500, view.token);
  if (moved) ($("inputs").querySelector("input") ?? $("title")).focus();
}

const counted = () => `Step ${view.number}${view.of ? ` of about ${view.of}` : ""}`;

// what was answered before it was broken off: marks may have been moved since
function showResumed(resumed) {
  $("resumed").hidden = !resumed;
  if (!resumed) return;
  const at = (moment) => moment ? new Date(moment).toLocaleString() : "an unknown time";
  $("since").textContent = `Broken off: begun ${at(resumed.since)}, answered last ${at(resumed.last)}. ` +
    "Go on below, or begin anew if camera, marks or sheet may have been moved since.";
  $("done").replaceChildren(...resumed.done.map(({ step, answers }) => {
    const said = Object.entries(answers).filter(([, value]) => value !== null && value !== "");
    const item = document.createElement("li");
    item.textContent = `${step}: ${said.map(([name, value]) => `${name} ${value}`).join(", ") || "done"}`;
    return item;
  }));
}

async function act(path, body, given) {
  const buttons = ["go", "undo", "repeat"].map($);
  for (const button of buttons) button.disabled = true;
  $("base").textContent = "";
  $("number").textContent = `${counted()}: under way ...`;
  $("waiting").textContent = path === "/step" ? view.waiting ?? "" : "";
  try {
    show(await call("POST", path, body), given);
  } catch (error) {
    if (error.status === 409) await current();
    $("base").textContent = error.message;
    $("number").textContent = counted();
  } finally {
    $("waiting").textContent = "";
    for (const button of buttons) button.disabled = false;
  }
}

// somebody's answer is under way, of this page before it was loaded again or of another one
async function watch(of) {
  if (view?.token !== of || view.type !== "progress") return;
  await current().catch(() => setTimeout(watch, 2000, of));
}

async function current() {
  const state = await call("GET", "/calibrations");
  $("main").hidden = false;
  $("under").textContent = state.name ?? "";
  if (state.name !== null) return show(await call("GET", "/step"));
  return start(state);
}

const day = (at) => new Date(at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

// a calibration: its name, which is clicked to do something with it, when, how good, what a check said
function row(one) {
  const name = make("button", { type: "button" }, one.name);
  name.addEventListener("click", () => { $("name").value = one.name; $("name").focus(); });
  if (one.problem !== null) return make("tr", {}, make("td", {}, name), make("td", { colspan: 4, class: "problem" }, `Cannot be read: ${one.problem}`));
  const check = one.checked_at === null ? "none" : `${one.stale ? "\u2717 stale" : "\u2713 still true"}, ${day(one.checked_at)}`;
  return make("tr", {}, make("td", {}, name), make("td", {}, one.kind), make("td", {}, day(one.written_at)),
    make("td", {}, one.held_out_mm === null ? "not known" : `${one.held_out_mm.toFixed(2)} mm`),
    make("td", { class: one.checked_at === null ? "" : `${one.stale ? "stale" : "true"}` }, check));
}

async function start(state) {
  view = null;
  const { listing } = await call("GET", "/listing");
  $("step").hidden = $("picture").hidden = $("camera").hidden = true;
  $("start").hidden = false;
  $("names").hidden = listing.length === 0;
  $("none").hidden = listing.length > 0;
  $("names").tBodies[0].replaceChildren(...listing.map(row));
  $("wizards").hidden = state.wizards.length < 2;
  $("wizards").replaceChildren(make("legend", {}, "What to do"), ...state.wizards.map((name, index) => make("label", { class: "check" },
    make("input", { type: "radio", name: "wizard", value: name, checked: index === 0 }), WIZARDS[name] ?? name)));
  $("name").focus();
}

// the wizard that is chosen; without wizards to choose from, the service's own
function chosen() {
  const one = document.querySelector("#wizards input:checked");
  return one ? { wizard: one.value } : {};
}

// ---------------------------------------------------------------------- picture

function shape(tag, attributes, text) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

// half axes and the angle of the ellipse that holds 95 % of a normal distribution
function ellipse([[a, b], [, d]]) {
  const mean = (a + d) / 2;
  const spread = Math.hypot((a - d) / 2, b);
  const factor = Math.sqrt(5.991);
  return [factor * Math.sqrt(mean + spread), factor * Math.sqrt(Math.max(mean - spread, 0)), Math.atan2(2 * b, a - d) / 2];
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((step) => step * power <= value) * power;
}

// lower left and upper right corner of some places, with room around them
function around(places) {
  const [xs, ys] = [0, 1].map((axis) => places.map((one) => one[axis]));
  const size = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)) || 1;
  const room = 0.25 * size;
  return [[Math.min(...xs) - room, Math.min(...ys) - room], [Math.max(...xs) + room, Math.max(...ys) + room]];
}

// cells over the view, rows from below, the stronger the larger the predicted error
function heatMap(rows, [[left, bottom], [right, top]]) {
  const [low, high] = spread(rows);
  const [width, height] = [(right - left) / rows[0].length, (top - bottom) / rows.length];
  const cells = rows.flatMap((row, number) => row.map((error, column) => shape("rect", {
    x: left + column * width, y: -(bottom + (number + 1) * height), width, height,
    "fill-opacity": high > low ? (0.05 + (0.45 * (error - low)) / (high - low)).toFixed(3) : 0.05,
  })));
  const group = shape("g", { class: "heat" });
  group.append(...cells);
  return group;
}

function spread(rows) {
  const errors = rows.flat();
  return [Math.min(...errors), Math.max(...errors)];
}

// ---------------------------------------------------------------------- choices

const fields = (name) => [...document.querySelectorAll("#form [name]")].filter((one) => one.name === name);

// whether the form says what a choice stands for
function isChosen({ answers }) {
  return Object.entries(answers).every(([name, value]) => fields(name).some((one) =>
    one.type === "checkbox" ? one.checked === value : one.value === `${value}` && (one.type !== "radio" || one.checked)));
}

// a click answers as the inputs do: a box is ticked or not, all else is set
function choose({ answers }) {
  for (const [name, value] of Object.entries(answers)) {
    for (const one of fields(name)) {
      if (one.type === "checkbox") one.checked = !one.checked;
      else if (one.type === "radio") one.checked = one.value === `${value}`;
      else one.value = value;
    }
  }
  showChosen();
}

function choice(one, [x, y], r) {
  const spot = shape("g", { class: "choice" });
  const name = shape("title", {}, one.label);
  spot.append(name, shape("circle", { cx: x, cy: y, r }));
  spot.addEventListener("click", () => choose(one));
  spot.choice = one;
  return spot;
}

function showChosen() {
  for (const spot of document.querySelectorAll(".choice")) spot.classList.toggle("chosen", isChosen(spot.choice));
}

// the camera's picture, as an image: whatever stands in it, nothing of it runs here
function drawPicture(svg, choices) {
  $("camera").hidden = !svg;
  const [, box] = /viewBox="([-\d. ]+)"/.exec(svg ?? "") ?? [];
  $("camera-choices").setAttribute("viewBox", box ?? "0 0 1 1");
  $("camera-choices").replaceChildren(...(box ? choices : []).map((one) => choice(one, one.at, 16)));
  $("camera-legend").textContent = box && choices.length ? "Click a point to choose it; the ring is the one that is suggested." : "";
  if (svg) $("camera-picture").src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
  else $("camera-picture").removeAttribute("src");
  showChosen();
}

function draw(preview) {
  const choices = view?.type === "form" ? preview?.choices ?? [] : [];
  drawPicture(preview?.svg, choices);
  const points = preview?.points ?? [];
  const next = preview?.next;
  const marked = preview?.marks ?? [];
  const empty = points.length === 0 && marked.length === 0;
  $("picture").hidden = empty;
  if (empty) return;
  const fitted = points.length > 0 && points.every((one) => one.at);
  const places = points.map((one) => (fitted ? one.at : one.camera));
  const origin = preview.camera_origin;
  const of = preview.of ?? "camera"; // what the points' own frame is: a sheet's, where one was looked at
  const marks = fitted ? [] : marked;
  const box = fitted ? preview.view : around(next ? [...places, ...marks, next] : [...places, ...marks]);
  const [[left, bottom], [right, top]] = box;
  const size = Math.max(right - left, top - bottom) / 1.5;
  const margin = 0.25 * size;
  const dot = size / 90;
  const plot = $("plot");
  plot.setAttribute("viewBox", `${left} ${-top} ${right - left} ${top - bottom}`);
  const heat = fitted ? preview.heat : null;
  const parts = heat ? [heatMap(heat, box)] : [];
  const line = (kind, [x, y], [dx, dy]) =>
    parts.push(shape("line", { class: kind, x1: x, y1: -y, x2: x + dx, y2: -(y + dy), "stroke-width": dot / 2.5 }));
  const label = (x, y, text) =>
    parts.push(shape("text", { x: x + 1.6 * dot, y: -y - 1.6 * dot, "font-size": 4 * dot }, text));

  let factor = 1;
  if (fitted) {
    const counted = points.filter((one) => !one.left_out);
    const worst = Math.max(...counted.map((one) => Math.hypot(one.residual[0], one.residual[1])),
      ...counted.map((one) => (one.covariance ? ellipse(one.covariance)[0] : 0)));
    factor = worst > 0 ? nice(Math.max(1, (0.12 * size) / worst)) : 1;
    const corner = [left + 0.6 * margin, top - 0.65 * margin];
    preview.robot_axes.forEach(([x, y], index) => {
      if (Math.hypot(x, y) < 0.05) return;
      line("axis-robot", corner, [0.4 * margin * x, 0.4 * margin * y]);
      label(corner[0] + 0.4 * margin * x, corner[1] + 0.4 * margin * y, `robot ${"xyz"[index]}`);
    });
    line("axis-camera", origin, [0.5 * margin, 0]);
    line("axis-camera", origin, [0, 0.5 * margin]);
    label(origin[0] + 0.5 * margin, origin[1] - 5 * dot, `${of} x`);
  }
  points.forEach((one, index) => {
    const [x, y] = places[index];
    if (one.left_out) {
      line("left-out", [x - dot, y - dot], [2 * dot, 2 * dot]);
      line("left-out", [x - dot, y + dot], [2 * dot, -2 * dot]);
      label(x, y, one.label);
      return;
    }
    if (fitted) {
      const [rx, ry] = one.residual;
      parts.push(shape("circle", { class: "seen", cx: x - rx, cy: -(y - ry), r: 1.8 * dot, "stroke-width": dot / 3 }));
      if (one.covariance) {
        const [long, short, angle] = ellipse(one.covariance);
        parts.push(shape("ellipse", {
          class: "ellipse", rx: long * factor, ry: short * factor,
          "stroke-width": dot / 4, "stroke-dasharray": `${dot} ${dot / 2}`,
          transform: `translate(${x - rx} ${-(y - ry)}) rotate(${(-angle * 180) / Math.PI})`,
        }));
      }
      line("residual", [x - rx, y - ry], [rx * factor, ry * factor]);
    }
    const kind = fitted && index === preview.worst ? "touched worst" : "touched";
    parts.push(shape("circle", { class: kind, cx: x, cy: -y, r: dot }));
    label(x, y, one.label);
  });
  for (const [x, y] of marks) {
    parts.push(shape("circle", { class: "seen", cx: x, cy: -y, r: 1.8 * dot, "stroke-width": dot / 3 }));
  }
  if (next && !fitted) {
    parts.push(shape("circle", { class: "next", cx: next[0], cy: -next[1], r: 2.5 * dot, "stroke-width": dot / 2 }));
    label(next[0], next[1], "next");
  }
  for (const one of choices) {
    if (points.length === 0) label(one.at[0] + 2 * dot, one.at[1] + 2 * dot, one.label);
    parts.push(choice(one, [one.at[0], -one.at[1]], 3 * dot));
  }
  plot.replaceChildren(...parts);
  showChosen();
  $("legend").textContent = fitted
    ? `Dots: touched, the worst in red. Rings: where the ${of} says. Lines: residuals, dashes: predicted error of the mapped point (95 %), both ${factor} times as large.${points.some((one) => one.left_out) ? " Crosses: left out." : ""} The robot's axes stand in the corner, the ${of}'s at its origin.${heat ? ` Colour, the stronger the larger: predicted error, ${spread(heat).map((error) => error.toFixed(3)).join(" to ")} mm rms.` : ""}`
    : choices.length && !points.length ? "Marks in the camera's frame: click those that are meant; filled ones are."
    : "Marks in the camera's frame: rings are seen, dots are touched, the red ring is next.";
  if (fitted && choices.length) $("legend").textContent += " Click a point to choose it.";
}

// ---------------------------------------------------------------------- page

$("form").addEventListener("input", showChosen);
$("form").addEventListener("submit", (event) => {
  event.preventDefault();
  const given = answers();
  act("/step", { token: view.token, answers: given }, given);
});
for (const what of ["undo", "repeat", "abort"]) {
  $(what).addEventListener("click", () => act(`/${what}`, { token: view.token }));
}
$("anew").addEventListener("click", async () => {
  try {
    const name = $("under").textContent;
    const { parameters } = view.resumed;
    show(await call("POST", "/start", { name, wizard: view.wizard, parameters, fresh: true }));
  } catch (error) {
    $("base").textContent = error.message;
  }
});
$("again").addEventListener("click", async () => start(await call("GET", "/calibrations")));
$("start-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  $("start-error").textContent = "";
  try {
    show(await call("POST", "/start", { ...chosen(), name: $("name").value, fresh: $("fresh").checked }));
    $("under").textContent = $("name").value;
  } catch (error) {
    $("start-error").textContent = error.message;
  }
});
$("gate").addEventListener("submit", (event) => {
  event.preventDefault();
  token = $("token").value.trim();
  sessionStorage.setItem("smartcam-token", token);
  $("gate").hidden = true;
  open();
});

function open() {
  current().catch((error) => {
    $("under").textContent = error.message;
  });
}

const given = new URLSearchParams(location.hash.slice(1));
if (given.get("token")) {
  sessionStorage.setItem("smartcam-token", given.get("token"));
  history.replaceState(null, "", location.pathname);
}
token = sessionStorage.getItem("smartcam-token");
open();
