// The emulator's page. Everything it does is one of the HTTP calls of GET /api.

import { $, BITS, SILENT_MS, draw, events, make, setText } from "./base.js";

const MAX_ROWS = 300; // log rows in the document

let token = null;
let camera = null; // name of the one shown
let state = {}; // as its events tell it
let scene = null;
let kinds = [];
let selected = null; // name of a part
let origin = 0; // of the times shown: the log's first
let stream = null; // AbortController of the event stream

// ---------------------------------------------------------------------- calls

class Refused extends Error {
  constructor(status, body) {
    super(body.error || `HTTP ${status}`);
    this.status = status;
    this.body = body;
  }
}

function headers(more = {}) {
  return token ? { ...more, Authorization: `Bearer ${token}` } : more;
}

async function call(method, path, body) {
  const options = { method, headers: headers(), cache: "no-store" };
  if (body !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  const response = await fetch(path, options);
  const answer = await response.json();
  if (response.ok) return answer;
  if (response.status === 401) askToken(answer);
  throw new Refused(response.status, answer);
}

const path = (...parts) => ["/api/cameras", ...[camera, ...parts].map((one) => encodeURIComponent(one))].join("/");

// What it did is told by the event stream: an answer may arrive behind an event that is newer.
async function act(what, method, where, body) {
  try {
    const answer = await call(method, where, body);
    const text = typeof what === "function" ? what(answer) : what;
    if (text) tell(text);
    return answer;
  } catch (error) {
    tell(reason(error), true);
    return null;
  }
}

function reason(error) {
  if (!(error instanceof Refused)) return `No answer: ${error.message}`;
  const { received, expected } = error.body;
  return expected ? `${received}; expected ${expected}` : error.message;
}

function tell(text, bad = false) {
  const box = make("div", { className: bad ? "bad" : "", textContent: text });
  $("told").replaceChildren(box);
  setTimeout(() => box.remove(), bad ? 9000 : 3500);
}

// ---------------------------------------------------------------------- token and address

function readAddress() {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.get("token")) sessionStorage.setItem("smartcam-token", given.get("token"));
  token = sessionStorage.getItem("smartcam-token");
  return given.get("camera");
}

function writeAddress() {
  const hash = camera === null ? "" : `#${new URLSearchParams({ camera })}`;
  history.replaceState(null, "", location.pathname + hash);
}

function askToken(answer) {
  stream?.abort();
  $("main").hidden = true;
  $("gate").hidden = false;
  $("gate-error").textContent = token ? `Refused: ${answer.received}` : "";
  live("lost", "token needed");
}

$("gate").addEventListener("submit", (event) => {
  event.preventDefault();
  token = $("token").value.trim();
  sessionStorage.setItem("smartcam-token", token);
  begin(camera);
});

// ---------------------------------------------------------------------- cameras

async function begin(wanted) {
  try {
    const [{ cameras }, answer] = await Promise.all([call("GET", "/api/cameras"), call("GET", "/api/faults")]);
    kinds = answer.kinds;
    $("gate").hidden = true;
    $("main").hidden = false;
    showCameras(cameras);
    const names = cameras.map((one) => one.name);
    if (names.length) choose(names.includes(wanted) ? wanted : names[0]);
    else live("lost", "no camera");
  } catch (error) {
    if (error instanceof Refused) {
      if (error.status !== 401) tell(reason(error), true);
      return;
    }
    live("lost", "no answer, trying again");
    setTimeout(() => begin(wanted), 1000);
  }
}

function showCameras(cameras) {
  const links = cameras.map((one) =>
    make("a", {
      href: `#${new URLSearchParams({ camera: one.name })}`,
      textContent: one.name,
      title: `${one.url}, ${one.mode}, application ${one.active_application}`,
      "data-mode": one.mode,
      "aria-current": String(one.name === camera),
    }),
  );
  const focused = document.activeElement?.textContent;
  $("cameras").replaceChildren(...links);
  if ($("cameras").dataset.focus) links.find((one) => one.textContent === focused)?.focus();
}

$("cameras").addEventListener("focusin", () => ($("cameras").dataset.focus = "1"));
$("cameras").addEventListener("focusout", (event) => event.relatedTarget && delete $("cameras").dataset.focus);

async function refreshCameras() {
  let cameras = [];
  try {
    if (!$("main").hidden && !document.hidden) {
      ({ cameras } = await call("GET", "/api/cameras"));
      showCameras(cameras);
    }
  } catch {
    // the stream tells that nobody answers
  }
  setTimeout(refreshCameras, Math.max(1000, cameras.length * 20));
}

function choose(name) {
  if (name === camera && stream && !stream.signal.aborted) return;
  stream?.abort();
  camera = name;
  state = {};
  scene = null;
  selected = null;
  moved.clear();
  for (const id of ["part-name", "part-x", "part-y", "part-theta"]) $(id).value = "";
  log.reset();
  latency.reset();
  writeAddress();
  for (const one of $("cameras").children) one.setAttribute("aria-current", String(one.textContent === name));
  document.title = `${name} · smartcam emulator`;
  listen(name);
}

addEventListener("hashchange", () => {
  const wanted = readAddress();
  if (wanted === null || wanted === camera) return;
  if (linkOf(wanted)) choose(wanted);
  else begin(wanted);
});

const linkOf = (name) => [...$("cameras").children].find((one) => one.textContent === name);

function live(mode, text) {
  if ($("live").dataset.state === mode && $("live").textContent === text) return;
  $("live").dataset.state = mode;
  $("main").classList.toggle("stale", mode === "lost");
  $("live").textContent = text;
}

// ---------------------------------------------------------------------- the event stream

async function listen(name) {
  const mine = (stream = new AbortController());
  let since = null; // at first: the last ones that the log has
  let pause = 300;
  while (!mine.signal.aborted) {
    const quiet = new AbortController();
    const stop = () => quiet.abort();
    mine.signal.addEventListener("abort", stop);
    let watchdog = setTimeout(stop, SILENT_MS);
    try {
      if (since === null) {
        const { log: range, time: now } = await call("GET", path());
        const { entries } = await call("GET", `${path("log")}?since=${range.first}&limit=1`);
        origin = entries.length ? entries[0].time : now;
        since = Math.max(range.first, range.next - MAX_ROWS);
      }
      const response = await fetch(`${path("events")}?since=${since}`, { headers: headers(), cache: "no-store", signal: quiet.signal });
      if (!response.ok) {
        const answer = await response.json();
        if (response.status === 401) return askToken(answer);
        if (response.status === 404) return begin(null);
        throw new Refused(response.status, answer);
      }
      for await (const event of events(response.body)) {
        if (mine.signal.aborted) return;
        clearTimeout(watchdog);
        watchdog = setTimeout(stop, SILENT_MS);
        pause = 300;
        live("live", "live");
        if (event.kind === "log") since = event.data.next;
        TAKE[event.kind]?.(event.data);
      }
    } catch {
      // aborted, refused or lost: told below
    } finally {
      clearTimeout(watchdog);
      mine.signal.removeEventListener("abort", stop);
    }
    if (mine.signal.aborted) return;
    live("lost", "not connected, trying again");
    await new Promise((done) => setTimeout(done, pause));
    pause = Math.min(3000, pause * 2);
  }
}

const seconds = (time, digits) => (time - origin).toFixed(digits);

const TAKE = {
  camera: takeState,
  scene: takeScene,
  faults: showFaults,
  log: (value) => {
    log.take(value);
    latency.take(value.entries);
  },
  clock: (value) => {
    setText("fact-time", `${seconds(value.time, 1)} s`);
    setText("fact-clock", value.clock_time?.slice(0, 19).replace("T", " ") ?? "");
  },
};

// ---------------------------------------------------------------------- the camera's state

function takeState(value) {
  if (value.name !== camera) return;
  const switched = state.active_application !== value.active_application;
  state = value;
  setText("camera-title", state.name);
  setText("mode", state.mode);
  $("mode").dataset.mode = state.mode;
  const link = linkOf(camera);
  if (link) link.dataset.mode = state.mode;
  setText("url", state.url);
  showAbilities();
  showStatus();
  showFacts();
  showControls();
  log.hint(state);
  if (switched) showScene();
}

// What a camera of this make cannot do is not there.
function showAbilities() {
  for (const element of document.querySelectorAll("[data-needs]")) {
    element.hidden = !element.dataset.needs.split(" ").some((one) => state.abilities.includes(one));
  }
  if (!state.applications.length) $("switch").hidden = true;
  $("main").classList.toggle("no-scene", !state.abilities.includes("scene"));
  if ($("kind").dataset.kinds !== String(state.fault_kinds)) showKinds();
}

function showStatus() {
  const known = BITS.map(([name]) => name);
  const more = state.status.filter((name) => !known.includes(name)).map((name) => [name, name.toLowerCase().replaceAll("_", " "), "warn"]);
  const rows = [...BITS, ...more].map(([name, label, tone]) => {
    const on = state.status.includes(name);
    return make("li", { className: tone, "data-on": String(on), "data-bit": name, title: name, textContent: label, "aria-label": `${label}: ${on ? "set" : "not set"}` });
  });
  $("status").replaceChildren(...rows);
}

function showFacts() {
  const application = state.applications.find((one) => one.id === state.active_application);
  const facts = {
    ...(application && applicationFacts(application)),
    Client: state.session ?? "none has the session",
    Connections: state.links.filter((one) => one !== state.session).join(", ") || (state.session ? "no other" : "none"),
    Speaks: `${state.dialect} over ${state.transport.toUpperCase()}`,
    ...(state.next_number !== null && { "Next number": state.next_number }),
    ...(state.queued_inputs !== null && { "Inputs queued": state.queued_inputs }),
    ...state.cells,
  };
  const quirks = Object.entries(state.quirks_chosen);
  if (quirks.length) facts.Quirks = quirks.map(([name, value]) => `${name} ${value}`).join(", ");
  const list = $("facts");
  const before = { time: $("fact-time")?.textContent ?? "", clock: $("fact-clock")?.textContent ?? "" };
  list.replaceChildren(
    ...Object.entries(facts).flatMap(([name, value]) => [make("dt", { textContent: name }), make("dd", { textContent: String(value), title: String(value) })]),
    ...(state.abilities.includes("clock") ? [make("dt", { textContent: "Its clock" }), make("dd", { id: "fact-clock", textContent: before.clock })] : []),
    make("dt", { textContent: "Log time" }), make("dd", { id: "fact-time", textContent: before.time }),
  );
}

function applicationFacts({ id, name, rate, layout }) {
  return {
    Application: `${id}${name ? ` ${name}` : ""}, ${rate === null ? "triggered" : `${rate} per second`}`,
    Layout: layout ?? (Object.keys(state.cells).length ? "cells" : "sends nothing"),
  };
}

function showControls() {
  const select = $("application");
  const wanted = JSON.stringify(state.applications.map((one) => [one.id, one.name]));
  if (select.dataset.rows !== wanted) {
    select.dataset.rows = wanted;
    select.replaceChildren(...state.applications.map((one) => make("option", { value: one.id, textContent: one.name ? `${one.id} ${one.name}` : String(one.id) })));
    select.value = state.active_application;
  } else if (select.dataset.active !== String(state.active_application)) {
    select.value = state.active_application;
  }
  select.dataset.active = state.active_application;
  for (const button of document.querySelectorAll("[data-condition]")) {
    button.setAttribute("aria-pressed", String(state.conditions[button.dataset.condition]));
  }
  const endian = $("endian");
  if (state.endian > 1 && !endian.querySelector(`[value="${state.endian}"]`)) endian.append(make("option", { value: state.endian, textContent: `${state.endian} (no such)` }));
  if (document.activeElement !== endian) endian.value = state.endian;
  $("reboot-seconds").placeholder = state.quirks.reboot_time;
  $("commands-field").hidden = !state.commands.length;
  if ($("commands").dataset.rows !== state.commands.join("\n")) {
    $("commands").dataset.rows = state.commands.join("\n");
    $("commands").replaceChildren(...state.commands.map((name) => make("button", { type: "button", textContent: name, "data-command": name })));
  }
}

$("trigger").addEventListener("click", () =>
  act((answer) => (answer.taken ? `Triggered: an inspection began.${answer.camera.session ? "" : " No client listens, so nobody gets the result."}` : `The trigger was not taken: ${whyNot(answer.camera)}.`), "POST", path("trigger")));

function whyNot(camera) {
  const application = camera.applications.find((one) => one.id === camera.active_application);
  if (camera.mode !== "running") return `the camera is ${camera.mode}`;
  if (application && application.rate !== null) return "the application runs freely";
  if (camera.conditions.system_error) return "there is a system error";
  return camera.processing ? "an inspection is under way" : "a fault drops it";
}

$("start").addEventListener("click", () => act("", "POST", path("start")));
$("stop").addEventListener("click", () => act("", "POST", path("stop")));
$("switch").addEventListener("submit", (event) => {
  event.preventDefault();
  act("", "POST", path("application"), { id: Number($("application").value), running: $("switch-running").checked });
});
for (const button of document.querySelectorAll("[data-condition]")) {
  const name = button.dataset.condition;
  button.addEventListener("click", () => act("", "POST", path("conditions"), { [name]: !state.conditions[name] }));
}
$("endian").addEventListener("change", () => act("", "POST", path("endian"), { endian: Number($("endian").value) }));
$("reboot").addEventListener("submit", (event) => {
  event.preventDefault();
  const seconds = $("reboot-seconds").value;
  act("Rebooting.", "POST", path("reboot"), seconds === "" ? {} : { seconds: Number(seconds) });
});
$("commands").addEventListener("click", (event) => {
  const name = event.target.dataset.command;
  if (name) act(`Command ${name} given.`, "POST", path("commands", name));
});
$("copy").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText(state.url);
    tell("Copied.");
  } catch {
    getSelection().selectAllChildren($("url")); // no clipboard: ready to be copied by hand
  }
});

// ---------------------------------------------------------------------- the scene

const MM = 1000;
const DEGREES = 180 / Math.PI;
let drag = null; // {name, pose, turning, grip}
let putting = false; // a PUT is under way
let putNext = null;

const moved = new Map(); // poses that were put and are not told by an event yet

function takeScene(value) {
  for (const part of value.parts) {
    const mine = moved.get(part.name);
    if (!mine) continue;
    const arrived = ["x", "y", "theta"].every((key) => part[key] === mine.pose[key]);
    if (arrived || performance.now() - mine.at > 1000) moved.delete(part.name);
    else Object.assign(part, mine.pose);
  }
  scene = value;
  showScene();
}

const points = (outline) => outline.map(([x, y]) => `${x * MM},${y * MM}`).join(" ");
const placed = (pose) => `translate(${pose.x * MM} ${pose.y * MM}) rotate(${pose.theta * DEGREES})`;

function showScene() {
  if (!scene) return;
  const width = scene.table.width * MM;
  const depth = scene.table.depth * MM;
  const looking = scene.table_applications.includes(state.active_application);
  $("picture").classList.toggle("away", !looking);
  const view = scene.field_of_view;
  const xs = [0, width, ...view.map((one) => one.x * MM)];
  const ys = [0, depth, ...view.map((one) => one.y * MM)];
  const [left, right, bottom, top] = [Math.min(...xs) - 17, Math.max(...xs) + 5, Math.min(...ys) - 10, Math.max(...ys) + 5];
  const svg = $("picture");
  svg.setAttribute("viewBox", `${left} ${-top} ${right - left} ${top - bottom}`);
  const focused = document.activeElement?.dataset?.part;
  const up = draw("g", { transform: "scale(1 -1)" });
  up.append(draw("rect", { class: "table", x: 0, y: 0, width, height: depth, rx: 2 }));
  for (let x = 50; x < width; x += 50) up.append(draw("line", { class: "rule", x1: x, x2: x, y1: 0, y2: depth }));
  for (let y = 50; y < depth; y += 50) up.append(draw("line", { class: "rule", x1: 0, x2: width, y1: y, y2: y }));
  up.append(draw("path", { class: "axis", d: "M0 14V0H14M-1.8 11.5L0 14L1.8 11.5M11.5 1.8L14 0L11.5 -1.8" }));
  up.append(draw("polygon", { class: "view", points: view.map((one) => `${one.x * MM},${one.y * MM}`).join(" ") }));
  scene.parts.forEach((part, index) => up.append(drawPart(part, index)));
  for (const one of scene.reported?.parts ?? []) up.append(drawReported(one));
  const current = scene.parts.find((part) => part.name === selected);
  if (current) up.append(...drawTurn(shownPose(current), extent(current)));
  const below = -bottom - 2;
  const labels = [draw("text", { x: 16, y: -1.5 }, "x"), draw("text", { x: 2.5, y: -11 }, "y")];
  for (let x = 0; x <= width; x += 50) labels.push(draw("text", { x, y: below, "text-anchor": "middle" }, x ? String(x) : "0 mm"));
  for (let y = 50; y <= depth; y += 50) labels.push(draw("text", { x: left + 13.5, y: -y + 1.8, "text-anchor": "end" }, String(y)));
  svg.replaceChildren(up, ...labels);
  if (focused) svg.querySelector(`[data-part="${CSS.escape(focused)}"]`)?.focus();
  $("part-names").replaceChildren(...scene.parts.map((part) => make("option", { value: part.name })));
  showPart();
}

const shownPose = (part) => (drag?.name === part.name ? drag.pose : part);
const extent = (part) => (part.outline ? Math.max(...part.outline.map(([x, y]) => Math.hypot(x, y))) * MM : 12);

function drawPart(part, index) {
  const { x, y, theta } = part;
  const body = part.outline ? draw("polygon", { class: "body", points: points(part.outline) }) : draw("circle", { class: "body", r: 10 });
  const label = `${part.name}: x ${(x * MM).toFixed(1)} mm, y ${(y * MM).toFixed(1)} mm, ${(theta * DEGREES).toFixed(1)} degrees${part.in_view ? "" : ", outside the field of view"}`;
  return draw("g", {
    class: `piece p${index % 7}`, transform: placed(shownPose(part)), tabindex: 0, role: "button",
    "data-part": part.name, "aria-pressed": String(part.name === selected), "aria-label": label,
  }, draw("title", {}, label), body, draw("path", { class: "cross", d: "M-2 0H6M0 -2V2" }));
}

function drawReported(one) {
  const outline = scene.parts.find((part) => part.name === one.name)?.outline;
  const shape = outline ? draw("polygon", { points: points(outline) }) : draw("circle", { r: 10 });
  return draw("g", { class: "reported", transform: placed(one), "data-reported": one.name ?? "" }, shape, draw("path", { d: "M-2.5 0H8M0 -2.5V2.5" }));
}

function drawTurn(pose, reach) {
  const far = reach + 9;
  const [cos, sin] = [Math.cos(pose.theta), Math.sin(pose.theta)];
  const [x, y] = [pose.x * MM, pose.y * MM];
  return [
    draw("line", { class: "arm", x1: x, y1: y, x2: x + cos * far, y2: y + sin * far }),
    draw("circle", { class: "turn", cx: x + cos * far, cy: y + sin * far, r: 3.2, "data-turn": "1" }),
  ];
}

function onTable(event) {
  const matrix = $("picture").getScreenCTM();
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix.inverse());
  return { x: point.x / MM, y: -point.y / MM };
}

function select(name) {
  selected = name;
  const part = scene.parts.find((one) => one.name === name);
  if (part) fillPart(part);
  showScene();
}

function fillPart(part) {
  $("part-name").value = part.name;
  $("part-x").value = (part.x * MM).toFixed(2);
  $("part-y").value = (part.y * MM).toFixed(2);
  $("part-theta").value = (part.theta * DEGREES).toFixed(2);
}

$("picture").addEventListener("pointerdown", (event) => {
  if (event.button !== 0 || !scene) return;
  const turning = Boolean(event.target.dataset.turn);
  const name = turning ? selected : event.target.closest("[data-part]")?.dataset.part;
  const part = scene.parts.find((one) => one.name === name);
  if (!part) return void (selected && select(null));
  const grip = onTable(event);
  event.preventDefault();
  selected = name;
  fillPart(part);
  drag = { name, turning, pose: { x: part.x, y: part.y, theta: part.theta }, grip: { x: grip.x - part.x, y: grip.y - part.y } };
  $("picture").setPointerCapture(event.pointerId);
  showScene();
  $("picture").querySelector(`[data-part="${CSS.escape(name)}"]`).focus();
});

$("picture").addEventListener("pointermove", (event) => {
  if (!drag) return;
  const at = onTable(event);
  drag.moved = true;
  if (drag.turning) drag.pose.theta = Math.atan2(at.y - drag.pose.y, at.x - drag.pose.x);
  else [drag.pose.x, drag.pose.y] = [at.x - drag.grip.x, at.y - drag.grip.y];
  fillPart({ name: drag.name, ...drag.pose });
  put(drag.name, drag.pose);
  showScene();
});

for (const kind of ["pointerup", "pointercancel"]) {
  $("picture").addEventListener(kind, () => {
    if (!drag) return;
    const { name, pose, moved } = drag;
    drag = null;
    const part = scene.parts.find((one) => one.name === name);
    if (moved && part) {
      Object.assign(part, pose);
      put(name, pose);
    }
    showScene();
  });
}

$("picture").addEventListener("keydown", (event) => {
  const name = event.target.dataset?.part;
  const part = scene?.parts.find((one) => one.name === name);
  if (!part) return;
  const step = (event.shiftKey ? 10 : 1) / MM;
  const turn = (event.shiftKey ? 15 : 1) / DEGREES;
  const moves = { ArrowLeft: [-step, 0, 0], ArrowRight: [step, 0, 0], ArrowUp: [0, step, 0], ArrowDown: [0, -step, 0], ",": [0, 0, turn], ".": [0, 0, -turn], "<": [0, 0, turn], ">": [0, 0, -turn] };
  const move = moves[event.key];
  if (event.key === "Enter" || event.key === " ") select(name);
  else if (event.key === "Escape") select(null);
  else if (event.key === "Delete") removePart(name);
  else if (move) {
    [part.x, part.y, part.theta] = [part.x + move[0], part.y + move[1], part.theta + move[2]];
    selected = name;
    fillPart(part);
    showScene();
    put(name, { x: part.x, y: part.y, theta: part.theta });
  } else return;
  event.preventDefault();
});

async function put(name, pose) {
  putNext = { name, pose: { x: pose.x, y: pose.y, theta: pose.theta } };
  moved.set(name, { pose: putNext.pose, at: performance.now() });
  if (putting) return; // the last one wins
  putting = true;
  while (putNext) {
    const next = putNext;
    putNext = null;
    await act("", "PUT", path("scene", "parts", next.name), next.pose);
  }
  putting = false;
}

async function removePart(name) {
  const answer = await act(`${name} is off the table.`, "DELETE", path("scene", "parts", name));
  if (!answer) return;
  moved.delete(name);
  if (selected === name) selected = null;
}

$("part").addEventListener("submit", async (event) => {
  event.preventDefault();
  const name = $("part-name").value;
  const pose = { x: $("part-x").valueAsNumber / MM, y: $("part-y").valueAsNumber / MM, theta: $("part-theta").valueAsNumber / DEGREES };
  selected = name;
  moved.delete(name);
  await act("", "PUT", path("scene", "parts", name), pose);
});
$("part-name").addEventListener("change", () => {
  if (scene?.parts.some((one) => one.name === $("part-name").value)) select($("part-name").value);
});
$("part-remove").addEventListener("click", () => $("part-name").value && removePart($("part-name").value));
$("scene-reset").addEventListener("click", async () => {
  moved.clear();
  select(null);
  await act("All parts lie where they lay at first.", "POST", path("scene", "reset"));
});

function showPart() {
  const part = scene.parts.find((one) => one.name === selected);
  const seen = scene.reported?.parts.find((one) => one.name === selected);
  let text = "";
  if (!scene.table_applications.includes(state.active_application)) {
    const names = scene.table_applications.map((id) => `${id} ${state.applications.find((one) => one.id === id)?.name ?? ""}`.trim());
    text = `The active application does not look at the table${names.length ? `; ${names.join(", ")} does: load it to see parts reported` : ""}.`;
  } else if (!selected) {
    text = scene.reported
      ? `Application ${scene.reported.application} reported ${scene.reported.parts.length} parts at ${seconds(scene.reported.time, 1)} s. Drag a part to move it.`
      : "Drag a part to move it. What the camera reports appears here after a trigger.";
  } else if (!part) text = `${selected} is not on the table.`;
  else if (!seen) text = `${selected} was not reported yet.`;
  else {
    const off = Math.hypot(seen.x - part.x, seen.y - part.y) * MM;
    const turned = (Math.atan2(Math.sin(seen.theta - part.theta), Math.cos(seen.theta - part.theta)) * DEGREES).toFixed(2);
    text = `Reported at x ${(seen.x * MM).toFixed(2)} mm, y ${(seen.y * MM).toFixed(2)} mm, ${(seen.theta * DEGREES).toFixed(2)}°: ${off.toFixed(2)} mm and ${turned}° off.`;
  }
  setText("part-seen", text);
}

// ---------------------------------------------------------------------- faults

const PRESETS = [ // label, fault, what is told
  ["Late result", { kind: "late_result", seconds: 10 }, "The next result comes 10 s late."],
  ["Lost link", { kind: "reset" }, "With its next message the camera resets the connection."],
  ["Camera stops", { kind: "stop" }, "An operator stops the application."],
];
const MESSAGE_FIELDS = ["on", "when", "nth", "times", "sender"];
const LABELS = { on: "message", when: "before or after it", nth: "from the nth", times: "how often", sender: "sender" };

function showKinds() {
  const able = kinds.filter((one) => state.fault_kinds?.includes(one.kind));
  $("kind").dataset.kinds = String(state.fault_kinds);
  $("presets").replaceChildren(...PRESETS.filter(([, fault]) => able.some((one) => one.kind === fault.kind)).map(([label, fault, about]) => {
    const button = make("button", { type: "button", textContent: label, title: about });
    button.addEventListener("click", () => act(about, "POST", path("faults"), fault));
    return button;
  }));
  const groups = { wire: make("optgroup", { label: "On the wire" }), device: make("optgroup", { label: "Of the device" }) };
  for (const one of able) groups[one.of].append(make("option", { value: one.kind, textContent: one.kind.replaceAll("_", " ") }));
  const before = $("kind").value;
  $("kind").replaceChildren(...Object.values(groups));
  for (const wanted of ["no_result", before]) if (able.some((one) => one.kind === wanted)) $("kind").value = wanted;
  showKind();
}

function showKind() {
  const kind = kinds.find((one) => one.kind === $("kind").value);
  if (!kind) return;
  $("kind-about").textContent = kind.about;
  $("fault-error").textContent = "";
  const { properties, required = [] } = kind.schema;
  const names = Object.keys(properties).filter((name) => name !== "kind");
  const field = (name) => makeField(name, properties[name], required.includes(name), kind.of);
  $("kind-fields").replaceChildren(...names.filter((name) => !MESSAGE_FIELDS.includes(name)).map(field));
  $("kind-message").replaceChildren(...MESSAGE_FIELDS.filter((name) => names.includes(name)).map(field));
}

// What a property of a JSON Schema is: its kind, its bounds, its choices, whether null may stand there.
function shapeOf(schema) {
  const ways = schema.anyOf ?? [schema];
  const choices = ways.find((one) => one.enum)?.enum ?? null;
  const types = ways.map((one) => one.type);
  const number = ways.find((one) => one.type === "integer" || one.type === "number");
  return { choices, types, number, nullable: types.includes("null") || (schema.default === null && "default" in schema) };
}

function makeField(name, schema, required, of) {
  const shape = shapeOf(schema);
  const id = `f-${name}`;
  const common = { id, name, title: (schema.description ?? "").replaceAll("`", "") };
  const label = LABELS[name] ?? name.replaceAll("_", " ");
  if (shape.types.includes("boolean")) {
    return make("label", { className: "check", title: common.title }, make("input", { ...common, type: "checkbox", checked: schema.default === true }), label);
  }
  let input;
  if (shape.choices && !shape.number) {
    const none = shape.nullable ? [make("option", { value: "", textContent: name === "sender" ? "by default" : "none" })] : [];
    input = make("select", { ...common, required }, ...none, ...shape.choices.map((one) => make("option", { value: one, textContent: one })));
    input.value = schema.default ?? (shape.nullable ? "" : shape.choices[0]);
  } else if (shape.choices) {
    input = make("input", { ...common, type: "text", autocomplete: "off", list: `${id}-list`, placeholder: of === "device" ? "at once" : "the next one" });
    const list = make("datalist", { id: `${id}-list` }, ...shape.choices.map((one) => make("option", { value: one })));
    return make("div", { className: "field" }, make("label", { htmlFor: id, textContent: label }), input, list);
  } else if (shape.number) {
    const { minimum, maximum, type } = shape.number;
    const empty = name === "times" ? "always" : shape.nullable ? "none" : "";
    input = make("input", { ...common, type: "number", required, placeholder: empty, step: type === "integer" ? "1" : "any" });
    if (minimum !== undefined) input.min = minimum;
    if (maximum !== undefined) input.max = maximum;
    input.value = schema.default ?? "";
  } else {
    const hint = shape.types.includes("object") ? "status=16 endian=0" : schema.format === "hex" || schema.anyOf?.some((one) => one.format === "hex") ? "hex digits" : "";
    input = make("input", { ...common, type: "text", required, autocomplete: "off", placeholder: hint });
  }
  return make("div", { className: "field" }, make("label", { htmlFor: id, textContent: label }), input);
}

function readFault() {
  const kind = kinds.find((one) => one.kind === $("kind").value);
  const fault = { kind: kind.kind };
  for (const [name, schema] of Object.entries(kind.schema.properties)) {
    const input = $(`f-${name}`);
    if (name === "kind" || !input) continue;
    const shape = shapeOf(schema);
    const text = input.value.trim();
    let value;
    if (input.type === "checkbox") value = input.checked;
    else if (text === "") value = shape.nullable && (schema.default ?? null) !== null ? null : undefined;
    else if (shape.choices) value = shape.number && /^(\d+|0x[0-9a-f]+)$/i.test(text) ? Number(text) : text;
    else if (shape.number) value = Number(text);
    else if (shape.types.includes("object")) value = pairs(text);
    else value = text;
    const absent = value === undefined || value === schema.default;
    if (!absent) fault[name] = value;
  }
  return fault;
}

function pairs(text) {
  const rows = text.split(/[\s,]+/).map((one) => one.split("="));
  return Object.fromEntries(rows.map(([key, value = ""]) => [key, /^-?\d+$/.test(value) ? Number(value) : value]));
}

$("kind").addEventListener("change", showKind);
$("fault").addEventListener("submit", async (event) => {
  event.preventDefault();
  $("fault-error").textContent = "";
  try {
    await call("POST", path("faults"), readFault());
  } catch (error) {
    const fields = error.body?.fields ?? [];
    $("fault-error").textContent = fields.length
      ? fields.map((one) => `${one.field.split(".").filter((part) => !/^\d+$/.test(part) && part !== $("kind").value).join(".") || "the fault"}: ${one.expected}`).join("; ")
      : reason(error);
  }
});
$("faults-clear").addEventListener("click", () => act("No fault waits.", "DELETE", path("faults")));

const ORDINALS = { 2: "nd", 3: "rd" };

function faultText(fault) {
  const { kind, on, sender, nth, times, ...rest } = fault;
  const more = Object.entries(rest).map(([name, value]) => `${name} ${typeof value === "object" ? JSON.stringify(value) : value}`);
  const where = [
    on !== undefined && on !== null ? `at ${on}` : sender ? `at a message of the ${sender}` : "",
    nth > 1 ? `from the ${nth}${ORDINALS[nth] ?? "th"}` : "",
    times === null ? "always" : times > 1 ? `${times} times` : "",
  ];
  return make("span", {}, make("b", { textContent: kind.replaceAll("_", " ") }), ` ${[...more, ...where].filter(Boolean).join(", ")}`);
}

function showFaults({ waiting, waiting_count: count, fired }) {
  setText("waiting-count", String(count));
  const none = (text) => make("li", { className: "none", textContent: text });
  $("waiting").replaceChildren(...waiting.slice(0, 50).map((one) => make("li", {}, faultText(one))), ...(count ? [] : [none("None waits.")]));
  const last = fired.slice(-30).reverse().map((one) =>
    make("li", {}, faultText(one.fault), make("span", { className: "when", textContent: `${seconds(one.time, 2)} s${one.message ? ` ${one.message}` : ""}` })));
  $("fired").replaceChildren(...last, ...(last.length ? [] : [none("None has happened.")]));
}

// ---------------------------------------------------------------------- latency

const MAX_POINTS = 100;

// From a client's Trigger, or where there was none from the fall of Waiting for Trigger, to the result.
const latency = {
  begun: null,
  points: [], // milliseconds

  reset() {
    this.begun = null;
    this.points = [];
    this.show();
  },

  take(entries) {
    const before = this.points.length;
    for (const one of entries) {
      const fell = one.message === "StatusReport" && !one.fields.status.includes("WAITING_FOR_TRIGGER");
      if (one.message === "Trigger" || (fell && this.begun === null)) this.begun = one.time;
      else if (one.message === state.run_ends && this.begun !== null) {
        this.points.push((one.time - this.begun) * MM);
        this.begun = null;
      }
    }
    this.points.splice(0, this.points.length - MAX_POINTS);
    if (this.points.length !== before || before === MAX_POINTS) this.show();
  },

  show() {
    const { points } = this;
    $("latency-empty").hidden = points.length > 0;
    const text = (value) => `${value.toFixed(value < 100 ? 1 : 0)} ms`;
    const [low, high] = [Math.min(...points), Math.max(...points)];
    setText("latency-last", points.length ? `last ${text(points.at(-1))}, ${text(low)} to ${text(high)} in ${points.length}` : "");
    const step = 300 / (MAX_POINTS - 1);
    const bars = points.map((value, index) => draw("rect", { x: index * step, width: step * 0.7, y: 70 - (66 * value) / high, height: (66 * value) / high }));
    $("latency").replaceChildren(...bars);
  },
};

// ---------------------------------------------------------------------- the log

const log = {
  entries: [], // the last MAX_ROWS that came
  missed: 0,
  paused: false,
  waiting: 0, // came while paused
  open: new Set(), // serials of the rows that are open

  reset() {
    this.entries = [];
    this.open.clear();
    this.missed = this.waiting = 0;
    this.show();
  },

  take({ entries, missed }) {
    const last = this.entries.at(-1);
    if (last && entries.length && entries[0].serial <= last.serial) this.reset(); // another emulator's
    this.missed += missed;
    this.entries.push(...entries);
    const gone = this.entries.splice(0, Math.max(0, this.entries.length - MAX_ROWS));
    if (this.paused) {
      this.waiting += entries.length;
      return this.tell();
    }
    for (const one of gone) {
      this.open.delete(one.serial);
      for (const row of $("log").querySelectorAll(`[data-serial="${one.serial}"]`)) row.remove();
    }
    this.append(entries.slice(-MAX_ROWS));
    this.tell();
  },

  append(entries) {
    const box = $("log-box");
    const follows = box.scrollHeight - box.scrollTop - box.clientHeight < 40;
    $("log").append(...entries.filter((one) => this.fits(one)).map(makeRow));
    if (follows) box.scrollTop = box.scrollHeight;
  },

  show() {
    $("log").replaceChildren();
    this.open.clear();
    this.append(this.entries);
    this.tell();
  },

  fits(entry) {
    const direction = $("log-direction").value;
    const text = $("log-filter").value.trim().toLowerCase();
    if (direction && entry.direction !== direction) return false;
    if ($("log-marked").checked && !isMarked(entry)) return false;
    return !text || searchable(entry).includes(text);
  },

  tell() {
    $("log-empty").hidden = this.entries.length > 0;
    const shown = $("log").querySelectorAll("tr.entry").length;
    const parts = [];
    if (this.entries.length) parts.push(shown === this.entries.length ? `${shown} messages` : `${shown} of ${this.entries.length} messages`);
    if (this.entries.length >= MAX_ROWS) parts.push("older ones: GET /api/cameras/…/log");
    if (this.waiting) parts.push(`${this.waiting} came since the pause`);
    if (this.missed) parts.push(`${this.missed} came too fast to be shown`);
    setText("log-state", parts.join(" · "));
  },

  hint(camera) {
    setText("log-hint", `smartcam watch "${camera.url}"`);
  },
};

// a client that searches for the dialect does nothing wrong
const isMarked = (entry) => Boolean(entry.fault || (entry.error && !entry.client_dialect));

const searchable = (entry) => [entry.message ?? "", entry.peer, entry.hex, entry.error ?? "", entry.fault ?? "", JSON.stringify(entry.fields), JSON.stringify(entry.values)].join(" ").toLowerCase();

function short(value) {
  if (value === null || value === undefined) return "null";
  if (Array.isArray(value)) {
    if (value.every((one) => typeof one === "string")) return value.join(" + ") || "no bit set";
    return `${value.length} records: ${value.slice(0, 3).map(short).join(" | ")}${value.length > 3 ? " …" : ""}`;
  }
  if (typeof value === "object") return Object.entries(value).map(([key, one]) => `${key} ${short(one)}`).join(", ");
  if (typeof value === "number" && !Number.isInteger(value)) return String(Number(value.toPrecision(5)));
  return typeof value === "string" ? `"${value}"` : String(value);
}

function says(entry) {
  if (entry.client_dialect) return `a client searches: it tried dialect ${entry.client_dialect}; this camera speaks ${state.dialect}`;
  if (entry.error) return entry.error;
  const fields = Object.entries(entry.fields).map(([key, value]) => `${key} ${short(value)}`).join(", ");
  const values = entry.values === null ? "" : short(entry.values);
  return [fields, values].filter(Boolean).join(": ");
}

function makeRow(entry) {
  const name = entry.client_dialect ? "search" : entry.message ?? entry.text ?? (entry.message_id === null ? "bytes" : `id 0x${entry.message_id.toString(16).padStart(2, "0")}`);
  const opener = make("button", { type: "button", className: "opener", "aria-expanded": "false", textContent: name });
  const what = make("td", { title: says(entry) });
  if (entry.fault) what.append(make("span", { className: "mark", textContent: `${entry.fault} ` }));
  what.append(says(entry));
  return make(
    "tr", { className: `entry ${entry.direction}${isMarked(entry) ? " marked" : ""}`, "data-serial": entry.serial },
    make("td", { className: "time", textContent: seconds(entry.time, 3) }),
    make("td", { className: "who", textContent: entry.direction === "in" ? "client" : "camera", title: entry.peer }),
    make("td", {}, opener), what,
    make("td", { className: "hex", textContent: entry.hex, title: `${entry.size} bytes` }),
  );
}

$("log").addEventListener("click", async (event) => {
  const opener = event.target.closest(".opener") ?? event.target.closest("tr.entry")?.querySelector(".opener");
  if (!opener || (event.target !== opener && String(getSelection()))) return;
  const row = opener.closest("tr");
  const serial = Number(row.dataset.serial);
  const isOpen = opener.getAttribute("aria-expanded") === "true";
  opener.setAttribute("aria-expanded", String(!isOpen));
  if (isOpen) {
    row.nextElementSibling?.matches(".detail") && row.nextElementSibling.remove();
    log.open.delete(serial);
    return;
  }
  log.open.add(serial);
  let entry = log.entries.find((one) => one.serial === serial);
  try {
    entry = await call("GET", path("log", serial));
  } catch {
    // gone from the emulator's log: what the page has must do
  }
  if (entry && log.open.has(serial) && row.isConnected) row.after(makeDetail(entry));
});

function makeDetail(entry) {
  const facts = {
    peer: entry.peer,
    "message id": entry.message_id === null ? undefined : `0x${entry.message_id.toString(16).padStart(2, "0")}`,
    payload: `${entry.size} bytes`,
    fault: entry.fault ?? undefined,
    error: entry.error ?? undefined,
    "on the wire": entry.wire === null ? undefined : entry.wire || "nothing",
  };
  const list = make("dl", { className: "facts" }, ...Object.entries(facts).filter(([, value]) => value !== undefined).flatMap(([key, value]) => [make("dt", { textContent: key }), make("dd", { textContent: value })]));
  const decoded = { ...entry.fields, ...(entry.values === null ? {} : { values: entry.values }) };
  const columns = make("div", { className: "cols" }, list);
  if (Object.keys(decoded).length) columns.append(make("pre", { textContent: JSON.stringify(decoded, null, 2) }));
  if (entry.hex) columns.append(make("pre", { textContent: dump(entry.hex) }));
  return make("tr", { className: "detail", "data-serial": entry.serial }, make("td", { colSpan: 5 }, columns));
}

function dump(hex) {
  const bytes = hex.split(" ");
  const lines = [];
  for (let at = 0; at < bytes.length; at += 16) {
    const part = bytes.slice(at, at + 16);
    const text = part.map((one) => { const code = parseInt(one, 16); return code >= 32 && code < 127 ? String.fromCharCode(code) : "."; }).join("");
    lines.push(`${at.toString(16).padStart(4, "0")}  ${part.join(" ").padEnd(Math.min(47, 3 * bytes.length - 1))}  ${text}`);
  }
  return lines.join("\n");
}

for (const [id, kind] of [["log-filter", "input"], ["log-direction", "change"], ["log-marked", "change"]]) {
  $(id).addEventListener(kind, () => log.show());
}
$("log-pause").addEventListener("click", () => {
  log.paused = !log.paused;
  $("log-pause").setAttribute("aria-pressed", String(log.paused));
  $("log-pause").textContent = log.paused ? "Go on" : "Pause";
  if (!log.paused) {
    log.waiting = 0;
    log.show();
    $("log-box").scrollTop = $("log-box").scrollHeight;
  }
});
$("log-clear").addEventListener("click", async () => {
  if (await act("The log is empty.", "DELETE", path("log"))) log.reset();
});

begin(readAddress());
refreshCameras();
