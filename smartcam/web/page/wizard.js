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
  $("gate-error").textContent = token ? `Refused: ${answer.came}` : "";
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

function show(next, given) {
  const moved = !view || view.token !== next.token;
  view = next;
  const asking = view.type === "form" || view.type === "confirm" || view.type === "progress";
  $("start").hidden = true;
  $("step").hidden = false;
  $("form").hidden = !asking;
  $("again").hidden = asking;
  $("number").textContent = asking ? `Step ${view.number}` : "";
  $("title").textContent = asking ? view.title : view.type === "result" ? "Done" : "Aborted";
  $("description").textContent = asking ? view.description
    : view.type === "abort" ? "What was measured stands in the journal." : "";
  showVerdict(view.verdict);
  $("notes").replaceChildren(...(view.notes ?? []).map(note));
  $("base").textContent = view.errors.base ?? "";
  $("result").replaceChildren(...Object.entries(view.result ?? {}).flatMap(([name, value]) =>
    [make("dt", {}, name), make("dd", {}, typeof value === "string" ? value : JSON.stringify(value))]));
  if (asking) {
    const values = moved ? view.defaults : { ...view.defaults, ...given };
    $("inputs").replaceChildren(...Object.entries(view.schema.properties).map(([name, schema]) =>
      input(name, schema, values[name], view.errors[name])));
    $("go").textContent = view.button;
    for (const what of ["undo", "repeat", "abort"]) $(what).hidden = !view.can.includes(what);
  }
  draw(view.preview);
  if (view.type === "progress") setTimeout(watch, 500, view.token);
  if (moved) ($("inputs").querySelector("input") ?? $("title")).focus();
}

async function act(path, body, given) {
  const buttons = ["go", "undo", "repeat"].map($);
  for (const button of buttons) button.disabled = true;
  $("base").textContent = "";
  $("number").textContent = `Step ${view.number}: under way ...`;
  try {
    show(await call("POST", path, body), given);
  } catch (error) {
    if (error.status === 409) await current();
    $("base").textContent = error.message;
    $("number").textContent = `Step ${view.number}`;
  } finally {
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

function start(state) {
  view = null;
  $("step").hidden = $("picture").hidden = $("camera").hidden = true;
  $("start").hidden = false;
  $("names").replaceChildren(...state.calibrations.map((name) => make("li", {}, name)));
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

// the camera's picture, as an image: whatever stands in it, nothing of it runs here
function drawPicture(svg) {
  $("camera").hidden = !svg;
  if (svg) $("camera-picture").src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
  else $("camera-picture").removeAttribute("src");
}

function draw(preview) {
  drawPicture(preview?.svg);
  const points = preview?.points ?? [];
  const next = preview?.next;
  const empty = points.length === 0 && !next;
  $("picture").hidden = empty;
  if (empty) return;
  const fitted = points.length > 0 && points.every((one) => one.at);
  const places = points.map((one) => (fitted ? one.at : one.camera));
  const origin = preview.camera_origin;
  const of = preview.of ?? "camera"; // what the points' own frame is: a sheet's, where one was looked at
  const marks = fitted ? [] : preview.marks ?? [];
  const box = fitted ? preview.view : around(next ? [...places, ...marks, next] : places);
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
  plot.replaceChildren(...parts);
  $("legend").textContent = fitted
    ? `Dots: touched, the worst in red. Rings: where the ${of} says. Lines: residuals, dashes: predicted error of the mapped point (95 %), both ${factor} times as large.${points.some((one) => one.left_out) ? " Crosses: left out." : ""} The robot's axes stand in the corner, the ${of}'s at its origin.${heat ? ` Colour, the stronger the larger: predicted error, ${spread(heat).map((error) => error.toFixed(3)).join(" to ")} mm rms.` : ""}`
    : "Marks in the camera's frame: rings are seen, dots are touched, the red ring is next.";
}

// ---------------------------------------------------------------------- page

$("form").addEventListener("submit", (event) => {
  event.preventDefault();
  const given = answers();
  act("/step", { token: view.token, answers: given }, given);
});
for (const what of ["undo", "repeat", "abort"]) {
  $(what).addEventListener("click", () => act(`/${what}`, { token: view.token }));
}
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
