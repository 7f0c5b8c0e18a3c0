// The page of a cloud: the newest one, one on the way at a time, drawn by WebGL and turned by hand.
// A page that is not looked at, as in a hidden tab, asks for none.

import { $, askToken, atGate, headers, live, setText, token } from "./base.js";

const FIELD = Math.PI / 4; // of view, from top to bottom
const SAMPLE = 20000; // points by which the view's centre is found: what lies far off does not count
const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1] };

// --- vectors
const add = (a, b, scale = 1) => a.map((value, axis) => value + scale * b[axis]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

// The largest of 1, 2, 5, 10, ... that is not above a length.
function round(length) {
  const ten = 10 ** Math.floor(Math.log10(length));
  return ten * (length >= 5 * ten ? 5 : length >= 2 * ten ? 2 : 1);
}
const metres = (value) => `${Number(value.toPrecision(3))} m`;

// --- drawing
const VERTEX = `#version 300 es
layout(location = 0) in vec3 place; layout(location = 1) in vec3 colour; out vec3 shade;
uniform mat4 view; uniform vec3 up; uniform float size;
uniform bool high; uniform vec2 heights; // colour by height, and where the colours begin and end
void main() {
  gl_Position = view * vec4(place, 1.0);
  gl_PointSize = size;
  float at = 3.0 * clamp((dot(place, up) - heights.x) / max(heights.y - heights.x, 1e-9), 0.0, 1.0);
  vec3 a = vec3(0.23, 0.30, 0.75), b = vec3(0.25, 0.75, 0.70), c = vec3(0.95, 0.85, 0.30), d = vec3(0.75, 0.15, 0.15);
  vec3 tone = at < 1.0 ? mix(a, b, at) : at < 2.0 ? mix(b, c, at - 1.0) : mix(c, d, at - 2.0);
  shade = high ? tone : colour;
}`;
const FRAGMENT = `#version 300 es
precision mediump float; in vec3 shade; out vec4 pixel;
void main() { pixel = vec4(shade, 1.0); }`;

const canvas = $("canvas");
let gl = null;
let places, shapes; // of the program's uniforms; what is drawn: points, axes
let cloud = null; // the one that is shown: what was said of it, its points and colours
let [centre, heights] = [[0, 0, 0], [0, 1]];
let [reach, length] = [1, 1]; // metres from the centre to what is farthest, about; of the axes
const eye = { yaw: 0, pitch: 0, distance: 3, target: [0, 0, 0] };

function setUp() {
  gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) return false;
  const program = gl.createProgram();
  for (const [kind, text] of [["VERTEX", VERTEX], ["FRAGMENT", FRAGMENT]]) {
    const shader = gl.createShader(gl[`${kind}_SHADER`]);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  places = Object.fromEntries(["view", "up", "heights", "high", "size"].map((name) => [name, gl.getUniformLocation(program, name)]));
  shapes = { points: shape(), axes: shape() };
  return true;
}
function shape() {
  const made = { array: gl.createVertexArray(), buffers: [gl.createBuffer(), gl.createBuffer()], count: 0 };
  gl.bindVertexArray(made.array);
  made.buffers.forEach((buffer, place) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.vertexAttribPointer(place, 3, place ? gl.UNSIGNED_BYTE : gl.FLOAT, place === 1, 0, 0);
  });
  return made;
}
function fill(made, points, colours) {
  gl.bindVertexArray(made.array);
  [points, colours].forEach((data, place) => {
    if (data) gl.enableVertexAttribArray(place);
    else gl.disableVertexAttribArray(place);
    gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[place]);
    gl.bufferData(gl.ARRAY_BUFFER, data ?? new Uint8Array(), gl.STATIC_DRAW);
  });
  made.count = points.length / 3;
}

const upward = () => AXES[$("up").value];
// The directions from the target to the eye, to the right and upwards on the screen.
function looking() {
  const up = upward();
  const front = up[1] || up[0] ? [0, 0, -1] : [0, -1, 0];
  const side = cross(up, front);
  const flat = add(front.map((value) => value * Math.cos(eye.yaw)), side, Math.sin(eye.yaw));
  const back = add(flat.map((value) => value * Math.cos(eye.pitch)), up, Math.sin(eye.pitch));
  const right = unit(cross(up, back));
  return { back, right, above: cross(back, right) };
}

// The matrix from metres to what WebGL shows, by columns.
function viewMatrix(width, height) {
  const { back, right, above } = looking();
  const from = add(eye.target, back, eye.distance);
  const zoom = 1 / Math.tan(FIELD / 2);
  const far = eye.distance + Math.hypot(...add(eye.target, centre, -1)) + 4 * reach + 2 * Math.hypot(...centre);
  const near = Math.min(eye.distance / 100, far / 1000);
  const rows = [right.map((value) => (value * zoom * height) / width), above.map((value) => value * zoom)];
  const depth = back.map((value) => (-value * (far + near)) / (far - near));
  const all = [...rows, depth, back.map((value) => -value)];
  const shifts = all.map((row, place) => -dot(row, from) - (place === 2 ? (2 * far * near) / (far - near) : 0));
  return [0, 1, 2].flatMap((axis) => all.map((row) => row[axis])).concat(shifts);
}

let waiting = false;
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    if (gl && !gl.isContextLost()) drawAll();
  });
}
function drawAll() {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = Math.max(1, Math.round(width * ratio));
  canvas.height = Math.max(1, Math.round(height * ratio));
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const matrix = viewMatrix(canvas.width, canvas.height);
  gl.uniformMatrix4fv(places.view, false, matrix);
  gl.uniform3fv(places.up, upward());
  gl.uniform2fv(places.heights, heights);
  gl.uniform1f(places.size, Number($("size").value) * ratio);
  const high = $("colour").value === "height";
  const axes = cloud && $("axes").checked;
  for (const [made, mode, count] of [[shapes.points, gl.POINTS, shapes.points.count], [shapes.axes, gl.LINES, axes ? 6 : 0]]) {
    gl.uniform1i(places.high, mode === gl.POINTS && high);
    gl.bindVertexArray(made.array);
    gl.drawArrays(mode, 0, count);
  }
  label(matrix, axes, width, height);
  $("scale").hidden = !cloud;
  $("legend").hidden = !cloud || !high;
  const pixels = height / (2 * Math.tan(FIELD / 2) * eye.distance); // of a metre at the target
  const bar = round(120 / pixels);
  $("scale").style.width = `${bar * pixels}px`;
  $("scale").firstElementChild.textContent = metres(bar);
  setText("low", metres(heights[0]));
  setText("high", metres(heights[1]));
}

// Put the axes' names where they end, as far as that is to be seen.
function label(matrix, axes, width, height) {
  for (const name of document.querySelectorAll(".axis")) {
    const end = [...AXES[name.dataset.axis].map((value) => value * length * 1.06), 1];
    const [x, y, , w] = [0, 1, 2, 3].map((row) => end.reduce((sum, value, column) => sum + value * matrix[4 * column + row], 0));
    const [left, top] = [((x / w + 1) / 2) * width, ((1 - y / w) / 2) * height];
    name.hidden = !axes || w <= 0 || left < 0 || top < 0 || left > width - 12 || top > height - 16;
    name.style.transform = `translate(${left}px, ${top}px) translate(-50%, -50%)`;
  }
}

// --- the cloud
// Where the points are: from 1 to 99 % of them along a direction.
function span(points, along) {
  const count = points.length / 3;
  const step = Math.max(1, Math.floor(count / SAMPLE));
  const found = new Float64Array(Math.ceil(count / step));
  for (let place = 0; place < found.length; place += 1) found[place] = dot(points.subarray(3 * place * step, 3 * place * step + 3), along);
  found.sort();
  return [found[Math.floor(0.01 * (found.length - 1))], found[Math.ceil(0.99 * (found.length - 1))]];
}
function measure() {
  if (!cloud?.points.length) return;
  const axes = [AXES.x, AXES.y, AXES.z];
  const spans = axes.map((axis) => span(cloud.points, axis));
  centre = spans.map(([low, high]) => (low + high) / 2);
  reach = Math.max(Math.hypot(...spans.map(([low, high]) => (high - low) / 2)), 1e-3);
  heights = span(cloud.points, upward());
  length = round(Math.max(reach, 1e-3));
  const ends = axes.flatMap((axis) => [0, 0, 0, ...axis.map((value) => value * length)]);
  const tones = [[217, 60, 50], [60, 160, 80], [70, 120, 230]].flatMap((tone) => [...tone, ...tone]);
  fill(shapes.axes, new Float32Array(ends), new Uint8Array(tones));
}
function reset() {
  const narrow = Math.min(1, canvas.clientWidth / Math.max(1, canvas.clientHeight));
  Object.assign(eye, { yaw: -0.35, pitch: 0.3, distance: (1.1 * reach) / Math.sin(FIELD / 2) / narrow, target: [...centre] });
  redraw();
}

function show(about, bytes) {
  const first = cloud === null;
  const points = new Float32Array(bytes.buffer, 0, 3 * about.points);
  const colours = about.colours ? new Uint8Array(bytes.buffer, 12 * about.points, 3 * about.points) : null;
  if (!colours && cloud?.colours !== null) $("colour").value = "height";
  $("colour").options[0].disabled = !colours;
  cloud = { about, points, colours };
  upload();
  if (first) reset();
  $("empty").hidden = true;
  setText("number", String(about.number));
  setText("points", about.of.toLocaleString("en"));
  setText("extent", about.high.map((value, axis) => Number((value - about.low[axis]).toPrecision(3))).join(" x ") + " m");
  setText("thinned", about.voxel ? `Thinned for this page: ${about.points.toLocaleString("en")} points, one for each voxel of ${metres(about.voxel)}.` : "");
}
function upload() {
  if (!cloud || !gl) return;
  fill(shapes.points, cloud.points, cloud.colours);
  measure();
  redraw();
}

// --- hands
const fingers = new Map(); // pointers that are down, and where they are
const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
function turn(x, y) {
  eye.yaw -= x;
  eye.pitch = clamp(eye.pitch + y, -1.55, 1.55);
  redraw();
}
function move(x, y) {
  const { right, above } = looking();
  const scale = (2 * Math.tan(FIELD / 2) * eye.distance) / canvas.clientHeight;
  eye.target = add(add(eye.target, right, -x * scale), above, y * scale);
  redraw();
}
function zoom(factor) {
  eye.distance = clamp(eye.distance * factor, reach / 1000, reach * 100);
  redraw();
}
const spread = ([a, b]) => ({ x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) });

canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  if (fingers.size < 2) fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
});
canvas.addEventListener("pointermove", (event) => {
  const last = fingers.get(event.pointerId);
  if (!last) return;
  const before = fingers.size === 2 ? spread([...fingers.values()]) : null;
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  const [x, y] = [event.clientX - last.x, event.clientY - last.y];
  if (before) {
    const now = spread([...fingers.values()]);
    if (now.apart && before.apart) zoom(before.apart / now.apart);
    move(now.x - before.x, now.y - before.y);
  } else if (event.shiftKey || event.buttons & 6) move(x, y);
  else turn(x * 0.008, y * 0.008);
});
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -200, 200) * 0.0015));
}, { passive: false });
canvas.addEventListener("keydown", ({ key }) => {
  if (key in TURNS) turn(...TURNS[key]);
  else if (key === "+" || key === "-") zoom(key === "+" ? 0.9 : 1.1);
});
canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => setUp() && upload());
for (const id of ["colour", "size", "axes"]) $(id).addEventListener("input", redraw);
$("up").addEventListener("input", () => (measure(), reset()));
$("reset").addEventListener("click", reset);
new ResizeObserver(redraw).observe(canvas);

// --- the server
let [socket, pause] = [null, 300];

function say(mode, text, alarm = "") {
  live(mode, text);
  setText("alarm", alarm);
  $("alarm").hidden = !alarm;
}

async function connect() {
  if (socket || document.hidden) return;
  socket = "asked for";
  try {
    const response = await fetch("/api/cloud", { headers: headers(), cache: "no-store" });
    const answer = await response.json();
    if (response.status === 401) return (socket = null), askToken(answer);
    if (!response.ok) throw new Error(answer.error);
    if (!cloud && !$("main").dataset.up) $("main").dataset.up = $("up").value = answer.up;
    $("main").hidden = false;
    $("gate").hidden = true;
    listen();
  } catch {
    socket = null;
    say("lost", "no server", "The page's server does not answer. Is what served it still running?");
    setTimeout(connect, 1000);
  }
}
function listen() {
  const one = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/clouds`, ["smartcam.cloud", ...(token() ? [`bearer.${token()}`] : [])]);
  one.binaryType = "arraybuffer";
  socket = one;
  let about, bytes, filled;
  one.addEventListener("open", () => say("live", "live"));
  one.addEventListener("message", ({ data }) => {
    pause = 300;
    if (typeof data === "string") {
      about = JSON.parse(data);
      bytes = new Uint8Array(about.bytes);
      filled = 0;
    } else {
      bytes.set(new Uint8Array(data), filled);
      filled += data.byteLength;
    }
    if (filled < about.bytes) return;
    if (!about.failure) show(about, bytes);
    say("live", "live", about.failure ? `Cloud ${about.number} cannot be shown: ${about.failure}` : "");
    one.send("next");
  });
  one.addEventListener("close", () => {
    if (socket !== one) return;
    socket = null;
    say("wait", "not connected");
    setTimeout(connect, pause);
    pause = Math.min(5000, 2 * pause);
  });
}
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) return connect();
  const one = socket;
  socket = null;
  if (one instanceof WebSocket) one.close();
  say("wait", "paused");
});

atGate(connect);
if (setUp()) connect();
else say("lost", "cannot draw", "This browser has no WebGL 2, by which clouds are drawn.");
