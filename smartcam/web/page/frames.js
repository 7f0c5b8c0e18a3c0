// The page of frames: the sources side by side, or one of them enlarged.

import { $, askToken, atGate, headers, live, setText } from "./base.js";
import { Features } from "./features.js";
import { Source } from "./pictures.js";

let sources = [];

// Ask what sources there are, and connect to those that are not connected.
let looking = false;
async function look() {
  if (looking || document.hidden) return;
  looking = true;
  try {
    const response = await fetch("/api/sources", { headers: headers(), cache: "no-store" });
    const answer = await response.json();
    if (response.status === 401) return askToken(answer);
    if (!response.ok) throw new Error(answer.error);
    arrange(answer.sources);
    for (const one of sources) one.connect();
    $("alarm").hidden = true;
    live("live", "live");
  } catch {
    $("alarm").hidden = false;
    setText("alarm", "The page's server does not answer. Is smartcam frames still running?");
    live("lost", "no server");
    setTimeout(look, 1000);
  } finally {
    looking = false;
  }
}

function arrange(told) {
  if (told.length !== sources.length || told.some(({ name }, index) => sources[index].title.textContent !== name)) {
    for (const one of sources) one.end();
    sources = told.map(({ index, name }) => new Source({ name, place: index, path: `/api/sources/${index}/pictures`, lost: look }));
    for (const one of sources) one.view.addEventListener("click", () => enlarge($("main").dataset.large ? null : one));
    sources.forEach((one, index) => told[index].features && one.panel.append(new Features(`/api/sources/${index}`).panel));
    $("main").replaceChildren(...sources.map((one) => one.panel));
    enlarge(null);
  }
  setText("name", told.map(({ name }) => name).join(", "));
  $("main").hidden = false;
  $("gate").hidden = true;
}

// Show one source alone, or all for null; what is not shown is not fetched.
function enlarge(large) {
  if (large) $("main").dataset.large = large.panel.dataset.place;
  else delete $("main").dataset.large;
  $("main").dataset.count = String(large ? 1 : sources.length);
  for (const one of sources) {
    one.panel.hidden = large !== null && one !== large;
    one.view.setAttribute("aria-pressed", String(one === large));
  }
}

document.addEventListener("keydown", ({ key }) => key === "Escape" && enlarge(null));
document.addEventListener("visibilitychange", look);
atGate(look);
setInterval(() => sources.forEach((one) => one.age()), 250);
look();
