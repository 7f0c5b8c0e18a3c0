// The page of colours: a picture, the mask of a range, and the range. The next picture is asked for
// when the last one was shown. A page that is not looked at, as in a hidden tab, asks for none.

import { $, askToken, atGate, call, make, Refused, setText } from "./base.js";

const CHANNELS = [["hue", 179], ["saturation", 255], ["value", 255]];
const OLD_S = 2;
const REST_MS = 1000; // before it is tried again
const viewer = Array.from(crypto.getRandomValues(new Uint8Array(12)), (one) => one.toString(16).padStart(2, "0")).join("");

let range = null; // what the sliders say
let shown = null; // what is on the page: sequence, size, range, age when it was sent, and when it came
let ended = false; // whether the source gives nothing more
let told = null; // why no picture comes

// ---------------------------------------------------------------------- pictures

// Show an answer of /api/look, and tell whether it was shown. newest: it is no picture of before
// with another range.
async function show(response, newest) {
  const data = await response.arrayBuffer();
  const came = performance.now();
  const length = new DataView(data).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const begin = 4 + length;
  const [picture, mask] = await Promise.all([
    createImageBitmap(new Blob([new Uint8Array(data, begin, about.jpeg)], { type: "image/jpeg" })),
    createImageBitmap(new Blob([new Uint8Array(data, begin + about.jpeg)], { type: "image/png" })),
  ]);
  const wanted = newest || !shown || about.sequence >= shown.sequence;
  if (wanted) {
    paint($("picture"), picture);
    frame(paint($("mask"), mask), about);
    shown = { ...about, came };
    setText("about", `${about.format} ${about.width}x${about.height}, number ${about.sequence}`);
    setText("part", `${(100 * about.share).toFixed(1)} % of the pixels`);
    list(about.regions);
  }
  picture.close();
  mask.close();
  age();
  return wanted;
}

function paint(canvas, bitmap) {
  if (canvas.width !== bitmap.width) canvas.width = bitmap.width;
  if (canvas.height !== bitmap.height) canvas.height = bitmap.height;
  const context = canvas.getContext("2d");
  context.drawImage(bitmap, 0, 0);
  return context;
}

function frame(context, { regions, width }) {
  context.lineWidth = Math.max(2, width / 320);
  context.strokeStyle = context.fillStyle = "#e0a13a";
  context.font = `${Math.max(14, width / 32)}px sans-serif`;
  regions.forEach(({ corners }, index) => {
    context.beginPath();
    corners.forEach(([x, y], corner) => (corner ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.closePath();
    context.stroke();
    context.fillText(String(index + 1), corners[0][0], corners[0][1]);
  });
}

function list(regions) {
  const degrees = (angle) => ((180 * angle) / Math.PI).toFixed(1);
  const texts = regions.map(({ area, sides: [long, short], ratio, orientation }, index) =>
    `${index + 1}: ${area} pixels, ${long.toFixed(0)} x ${short.toFixed(0)}, sides ${ratio.toFixed(2)}:1, ${degrees(orientation)}\u00b0`);
  $("regions").replaceChildren(...texts.map((text) => make("li", { textContent: text })));
}

const look = (again) => call("/api/look", { viewer, range, again });
const asked = () => JSON.stringify(range);
const rest = () => new Promise((resolve) => setTimeout(resolve, REST_MS));

// Show pictures for as long as somebody looks.
let running = false;
async function run() {
  if (running) return;
  running = true;
  try {
    while (!document.hidden && !ended) {
      try {
        await show(await look(false), true);
        say(null);
        mask();
      } catch (error) {
        if (error instanceof Refused && error.status === 401) return begin();
        ended = error instanceof Refused && error.status === 410;
        say(error instanceof Refused ? error.message : unreachable());
        if (!ended) await rest();
      }
    }
  } finally {
    running = false;
    age();
  }
}

// Show another range where the picture that is shown has another one.
let masking = false;
async function mask() {
  if (masking) return;
  masking = true;
  try {
    while (shown && JSON.stringify(shown.range) !== asked()) {
      if (!(await show(await look(true), false))) break;
    }
  } catch (error) {
    if (!(error instanceof Refused)) say(unreachable());
  } finally {
    masking = false;
  }
}

const unreachable = () => "The page's server does not answer. Is smartcam frames colours still running?";

function say(text) {
  told = text;
  $("alarm").hidden = text === null;
  setText("alarm", text ?? "");
  age();
}

function age() {
  const old = shown && shown.age + (performance.now() - shown.came) / 1000 > OLD_S;
  $("main").classList.toggle("old", Boolean(old) && !ended);
  const state = ended ? ["lost", "ended"] : told ? ["lost", "no picture"] : !shown ? ["wait", "waiting for a picture"] : old ? ["wait", "not fresh"] : ["live", "live"];
  $("live").dataset.state = state[0];
  setText("live", state[1]);
}

// ---------------------------------------------------------------------- the range

const inputs = CHANNELS.map(([name, most]) => {
  const ends = ["from", "to"].map((end, place) => {
    const slider = make("input", { type: "range", id: `${name}-${end}`, min: "0", max: String(most), step: "1" });
    slider.addEventListener("input", () => slide(name, place, Number(slider.value)));
    return slider;
  });
  const parts = ends.flatMap((slider, place) => [make("label", { htmlFor: slider.id, textContent: `${name} ${place ? "to" : "from"}` }), slider, make("output", { htmlFor: slider.id })]);
  $("sliders").append(make("div", { className: "channel" }, ...parts.slice(0, 3), make("div", { className: `scale ${name}` }), ...parts.slice(3)));
  return [name, ends];
});

function slide(name, place, value) {
  const ends = [...range[name]];
  ends[place] = value;
  if (name !== "hue" && ends[0] > ends[1]) ends[1 - place] = value; // it takes the other one along
  set({ ...range, [name]: ends });
}

function set(wanted) {
  range = wanted;
  for (const [name, ends] of inputs) {
    ends.forEach((slider, place) => {
      slider.value = String(range[name][place]);
      slider.parentElement.querySelectorAll("output")[place].textContent = slider.value;
    });
  }
  const tuple = (name) => `${name}=(${range[name].join(", ")})`;
  setText("python", `ColourRange(${CHANNELS.map(([name]) => tuple(name)).join(", ")})`);
  setText("json", `{${CHANNELS.map(([name]) => `"${name}": [${range[name].join(", ")}]`).join(", ")}}`);
  setText("copied", "");
  mask();
}

$("all").addEventListener("click", () => set({ hue: [0, 179], saturation: [0, 255], value: [0, 255] }));

$("picture").addEventListener("click", async ({ offsetX, offsetY, target }) => {
  if (!shown) return;
  const x = Math.min(shown.width - 1, Math.floor((offsetX * shown.width) / target.clientWidth));
  const y = Math.min(shown.height - 1, Math.floor((offsetY * shown.height) / target.clientHeight));
  try {
    set((await (await call("/api/around", { viewer, sequence: shown.sequence, x, y })).json()).range);
  } catch (error) {
    setText("copied", "");
    say(error instanceof Refused ? `The colour there cannot be taken: ${error.message}` : unreachable());
  }
});

for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", async () => {
    const code = $(button.dataset.copy);
    try {
      await navigator.clipboard.writeText(code.textContent);
      setText("copied", "Copied.");
    } catch {
      getSelection().selectAllChildren(code); // no clipboard for a page of another machine
      setText("copied", "Selected: copy it with the keyboard.");
    }
  });
}

// ---------------------------------------------------------------------- the token, and the beginning

async function begin() {
  try {
    const { name, range: first } = await (await call("/api/source")).json();
    setText("name", name);
    $("gate").hidden = true;
    $("main").hidden = false;
    if (!range) set(first);
    say(null);
    run();
  } catch (error) {
    if (error instanceof Refused && error.status === 401) return askToken(error.answer);
    say(unreachable());
    setTimeout(begin, REST_MS);
  }
}

document.addEventListener("visibilitychange", () => !document.hidden && range && run());

atGate(begin);
setInterval(age, 250);
begin();
