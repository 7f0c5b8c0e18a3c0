// The page of teaching: a picture with what the tools saw, the settings of the tools, and what they
// find in all pictures. Whatever is changed is tried at once; only Save writes the file.

import { $, askToken, atGate, call, draw, headers, live, make, Refused, setText } from "./base.js";

const TRY_MS = 250; // after the last change

let state = null; // of the server: camera, application, kinds, pictures
let tools = {}; // texts of the settings, by the tools' keys
let current = ""; // key of the tool that is edited
let shown = 0; // number of the picture
let found = new Map(); // what was found, by picture
let bad = new Set(); // pictures of parts that are not good
const images = new Map(); // data of pictures

function alarm(error) {
  if (error instanceof Refused && error.status === 401) return askToken(error.answer);
  const text = error && (error instanceof Refused ? error.message : "The page's server does not answer. Is smartcam teach still running?");
  $("alarm").hidden = !text;
  setText("alarm", text ?? "");
}

// ---------------------------------------------------------------------- the picture

async function show(number) {
  shown = number;
  const one = state.pictures.find((picture) => picture.number === number);
  if (!one) return;
  if (!images.has(number)) {
    const data = await (await call(`/api/pictures/${number}`)).blob();
    images.set(number, await new Promise((done, failed) => {
      const reader = new FileReader();
      reader.onload = () => done(reader.result);
      reader.onerror = failed;
      reader.readAsDataURL(data);
    }));
    if (images.size > 30) images.delete(images.keys().next().value);
  }
  if (shown !== number) return;
  const [width, height] = one.size;
  $("canvas").setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
  for (const [name, value] of Object.entries({ x: -0.5, y: -0.5, width, height, href: images.get(number) })) $("picture").setAttribute(name, value);
  setText("shown-name", one.name);
  setText("shown-size", `${width} x ${height}`);
  mark();
  hint();
}

function mark() {
  const one = found.get(shown);
  const [width] = state.pictures.find(({ number }) => number === shown)?.size ?? [640];
  const size = width / 45;
  const shapes = (one?.marks ?? []).flatMap(({ kind, role, text, points }) => {
    const drawn = [];
    const places = points.filter((point) => point.every((value) => value !== null));
    if (!places.length) return drawn;
    const list = places.map((point) => point.join(",")).join(" ");
    if (kind === "polygon") drawn.push(draw("polygon", { class: `mark ${role}`, points: list }));
    if (kind === "line") drawn.push(draw("polyline", { class: `mark ${role}`, points: list }));
    if (kind === "points") drawn.push(...places.map(([x, y]) => draw("circle", { class: `mark ${role}`, cx: x, cy: y, r: size / 4 })));
    if (text) {
      const label = draw("text", { class: role, x: places[0][0] + size / 3, y: places[0][1] - size / 3, "font-size": size });
      label.textContent = text;
      drawn.push(label);
    }
    return drawn;
  });
  $("marks").replaceChildren(...shapes);
  $("said").className = `verdict ${one ? (one.ok ? "good" : "bad") : ""}`;
  setText("said", one ? (one.ok ? "ok" : `not ok: ${one.reason}`) : "");
}

function place(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform($("canvas").getScreenCTM().inverse());
  const [width, height] = state.pictures.find(({ number }) => number === shown).size;
  return [Math.min(width, Math.max(0, Math.round(point.x + 0.5))), Math.min(height, Math.max(0, Math.round(point.y + 0.5)))];
}

let corner = null;
$("canvas").addEventListener("pointerdown", (event) => {
  if (!shown || !current) return;
  corner = place(event);
  $("canvas").setPointerCapture(event.pointerId);
  event.preventDefault();
});
$("canvas").addEventListener("pointermove", (event) => {
  if (corner) outline(place(event));
});
$("canvas").addEventListener("pointerup", (event) => {
  if (!corner) return;
  const end = place(event);
  const [wanted, begin] = [box(end), corner];
  hideOutline();
  if (measured()) {
    if (Math.hypot(end[0] - begin[0], end[1] - begin[1]) >= 2) setWay(begin, end);
  } else if (wanted[2] >= 2 && wanted[3] >= 2) set(taughtHere() ? "part" : "region", `[${wanted.join(", ")}]`);
});
$("canvas").addEventListener("pointercancel", hideOutline);

const box = ([x, y]) => [Math.min(x, corner[0]), Math.min(y, corner[1]), Math.abs(x - corner[0]), Math.abs(y - corner[1])];

function outline(end) {
  const [x, y, width, height] = box(end);
  const shape = measured() ? $("drawn-way") : $("drawn");
  const values = measured() ? { x1: corner[0], y1: corner[1], x2: end[0], y2: end[1] } : { x: x - 0.5, y: y - 0.5, width, height };
  shape.removeAttribute("hidden");
  for (const [name, value] of Object.entries(values)) shape.setAttribute(name, value);
}

function hideOutline() {
  corner = null;
  for (const id of ["drawn", "drawn-way"]) $(id).setAttribute("hidden", "");
}

// Measurements have no region: a drag is the way of their strip, along their line, or from the
// centre of their circle to its rim. Those of two things are written by hand.
const pair = (begin, end) => `[[${begin.join(", ")}], [${end.join(", ")}]]`;
const WAYS = {
  width: (begin, end) => ({ across: pair(begin, end) }),
  edge: (begin, end) => ({ across: pair(begin, end) }),
  line: (begin, end) => ({ along: pair(begin, end) }),
  circle: (begin, end) => ({ centre: `[${begin.join(", ")}]`, radius: String(Math.round(Math.hypot(end[0] - begin[0], end[1] - begin[1]))) }),
};
const VALUE = String.raw`(\[\s*\[[^\]]*\]\s*,\s*\[[^\]]*\]\s*\]|\[[^\]]*\]|[-+.\d]+)`;

const measured = () => kindOf(current) === "measure";

// A part is taught from a picture: in that one a drag goes around the part.
const located = () => kindOf(current) === "locate";
const fileOf = (number) => state.pictures.find((picture) => picture.number === number)?.file ?? "";
const taughtHere = () => located() && fileOf(shown) !== "" && tools[current].taught === fileOf(shown);

function hint() {
  let text = "Drag in the picture to draw the region in which the tool looks.";
  if (measured()) text = "Drag in the picture across the two edges of a width or over one edge, along a line, or from a circle's centre to its rim: whichever has a setting; without one, a width.";
  else if (taughtHere()) text = "Drag around the part, some pixels away from it: this is the picture that it is taught from.";
  setText("how", text);
  $("teach").hidden = !located() || !fileOf(shown) || taughtHere();
}

$("teach").addEventListener("click", () => {
  for (const name of ["model", "outline", "pixels_per_mm", "unit", "part"]) delete tools[current][name];
  tools[current].taught = fileOf(shown);
  listTools();
  changed();
});

function setWay(begin, end) {
  const given = Object.keys(tools[current]).filter((name) => tools[current][name].trim());
  if (given.includes("distance") || given.includes("angle")) return setText("problem", "A distance or an angle has two things: write them by hand.");
  const name = Object.keys(WAYS).find((one) => given.includes(one)) ?? "width";
  let text = tools[current][name] ?? "";
  for (const [key, value] of Object.entries(WAYS[name](begin, end))) {
    const there = new RegExp(String.raw`\b${key}:\s*${VALUE}`);
    if (there.test(text)) text = text.replace(there, `${key}: ${value}`);
    else text = text.trim() ? text.replace(/^\s*\{/, `{${key}: ${value}, `) : `{${key}: ${value}}`;
  }
  set(name, text);
}

// ---------------------------------------------------------------------- the tools

const kindOf = (key) => key.split(" ")[0];

function listTools() {
  $("tool").replaceChildren(...Object.keys(tools).map((key) => make("option", { value: key, textContent: key })));
  if (!(current in tools)) current = Object.keys(tools)[0] ?? "";
  $("tool").value = current;
  $("remove").disabled = !current;
  $("whole").disabled = !current || measured();
  hint();
  const fields = state.kinds[kindOf(current)] ?? {};
  $("settings").replaceChildren(...Object.entries(fields).map(([name, about]) => {
    const input = make("input", { id: `set-${name}`, name, value: tools[current][name] ?? "", spellcheck: false });
    input.addEventListener("input", () => set(name, input.value, true));
    return make("div", {}, make("label", { htmlFor: input.id, textContent: name }), input, make("p", { className: "note", textContent: about }));
  }));
}

function set(name, text, typed = false) {
  tools[current][name] = text;
  const input = $(`set-${name}`);
  if (input && !typed) input.value = text;
  changed();
}

$("settings").addEventListener("submit", (event) => event.preventDefault());
$("tool").addEventListener("change", () => {
  current = $("tool").value;
  listTools();
});
$("whole").addEventListener("click", () => set("region", ""));
$("remove").addEventListener("click", () => {
  delete tools[current];
  listTools();
  changed();
});
$("add").addEventListener("click", () => {
  const name = $("tool-name").value.trim();
  const key = name ? `${$("kind").value} ${name}` : $("kind").value;
  if (!(key in tools)) tools[key] = {};
  current = key;
  $("tool-name").value = "";
  listTools();
  changed();
});

// ---------------------------------------------------------------------- trying

let timer = 0;
let trying = false;
let again = false;

function changed() {
  setText("saved", "Not saved yet.");
  hint();
  clearTimeout(timer);
  timer = setTimeout(attempt, TRY_MS);
}

async function attempt() {
  if (trying) {
    again = true;
    return;
  }
  trying = true;
  live("wait", "looking");
  try {
    if (Object.keys(tools).length && state.pictures.length) {
      const answer = await (await call("/api/try", { tools })).json();
      found = new Map(answer.found.map((one) => [one.picture, one]));
      $("remarks").replaceChildren(...answer.remarks.map((text) => make("li", { textContent: text })));
    } else {
      found = new Map();
    }
    setText("problem", "");
    alarm(null);
  } catch (error) {
    found = new Map();
    $("remarks").replaceChildren();
    if (error instanceof Refused && error.status === 422) setText("problem", error.message);
    else alarm(error);
  }
  trying = false;
  live("live", "ready");
  list();
  mark();
  if (again) {
    again = false;
    attempt();
  }
}

function list() {
  const rows = state.pictures.map(({ number, name }) => {
    const one = found.get(number);
    const good = make("input", { type: "checkbox", checked: !bad.has(number), ariaLabel: `${name} shows a good part` });
    good.addEventListener("click", (event) => event.stopPropagation());
    good.addEventListener("change", () => {
      if (good.checked) bad.delete(number);
      else bad.add(number);
      count();
    });
    const values = Object.entries(one?.values ?? {}).filter(([key]) => key !== "ok" && key !== "reason");
    const cells = [good, name, verdict(one), values.map(([key, value]) => `${key} ${brief(value)}`).join(", "), one?.milliseconds === undefined ? "" : `${one.milliseconds.toFixed(1)} ms`];
    const row = make("tr", { "data-picture": String(number), "aria-current": String(number === shown) }, ...cells.map((cell) => make("td", {}, cell)));
    row.addEventListener("click", () => show(number).then(list).catch(alarm));
    return row;
  });
  $("rows").replaceChildren(...rows);
  count();
}

function verdict(one) {
  if (!one) return "";
  return make("span", { className: one.ok ? "good" : "bad", textContent: one.ok ? "ok" : `not ok: ${one.reason}` });
}

function brief(value) {
  if (typeof value === "number") return String(Number(value.toPrecision(6)));
  return typeof value === "string" ? value : JSON.stringify(value);
}

function count() {
  const wrong = state.pictures.filter(({ number }) => found.has(number) && found.get(number).ok === bad.has(number)).length;
  setText("counts", found.size ? `${found.size} looked at, ${wrong} judged otherwise than you` : "");
  $("learn").disabled = !found.size || bad.size === state.pictures.length;
}

$("learn").addEventListener("click", async () => {
  try {
    const good = state.pictures.map(({ number }) => number).filter((number) => !bad.has(number));
    const answer = await (await call("/api/learn", { tools, good })).json();
    tools = answer.tools;
    $("learned").replaceChildren(...answer.learned.map((text) => make("li", { textContent: text })));
    setText("problem", "");
    listTools();
    changed();
  } catch (error) {
    if (error instanceof Refused && error.status === 422) setText("problem", error.message);
    else alarm(error);
  }
});

$("save").addEventListener("click", async () => {
  try {
    const { saved } = await (await call("/api/save", { tools })).json();
    setText("problem", "");
    setText("saved", `Saved in ${saved}.`);
  } catch (error) {
    if (error instanceof Refused && error.status === 422) setText("problem", error.message);
    else alarm(error);
  }
});

$("shoot").addEventListener("click", async () => {
  try {
    const answer = await (await fetch("/api/pictures", { method: "POST", headers: headers() })).json();
    if (!answer.pictures) throw new Refused(0, answer);
    state.pictures = answer.pictures;
    await show(answer.number);
    alarm(null);
    attempt();
  } catch (error) {
    alarm(error);
  }
});

// ---------------------------------------------------------------------- the beginning

async function begin() {
  try {
    state = await (await call("/api/state")).json();
  } catch (error) {
    alarm(error);
    return;
  }
  tools = state.tools;
  $("main").hidden = false;
  $("shoot").hidden = !state.live;
  setText("name", `${state.camera} in ${state.file}`);
  setText("application", `Application ${state.application}${state.name === String(state.application) ? "" : `, ${state.name}`}`);
  $("kind").replaceChildren(...Object.keys(state.kinds).map((kind) => make("option", { value: kind, textContent: kind })));
  listTools();
  list();
  live("live", "ready");
  if (state.pictures.length) await show(state.pictures[0].number).catch(alarm);
  attempt();
}

atGate(begin);
begin();
