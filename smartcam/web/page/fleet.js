// The fleet's page: a table of which only the rows in sight are in the document, and cross the wire.

import { $, askToken, atGate, headers, live, make, setText, takeUnits, token } from "./base.js";
import { drawChart, drawLegend } from "./fleet_chart.js";
import { followOutlets } from "./fleet_outlets.js";
import { Row } from "./fleet_row.js";

const PROTOCOL = "smartcam.fleet";
const SILENT_MS = 12000; // the server says every five seconds that nothing has changed
const MAX_ROWS = 120; // that the server tells at a time
const AHEAD = 12; // rows above and below those on the screen

const FILTERS = { all: "All", connected: "Connected", errors: "In trouble", busy: "Busy", stopped: "Stopped" };
const COLUMNS = [
  ["", "Last", false],
  ["name", "Camera", false],
  ["state", "State", false],
  ["last", "Last result", false],
  ["rate", "Per second", true],
  ["", "Results", true],
  ["errors", "Errors", true],
  ["", "Last ten hours", false],
];
const SORTS = { name: "name", state: "state, worst first", rate: "rate", last: "last result", errors: "errors" };
const DOWN = new Set(["rate", "last", "errors"]); // the most first
const TOTALS = { cameras: "cameras", connected: "connected", rate: "results/s", failures: "errors so far" };

let socket = null;
let wanted = { search: "", filter: "all", sort: "name", descending: false }; // which rows, in which order
let said = ""; // what the server was told to be in sight
let table = { found: 0, first: 0, names: [] }; // what it has told
let fields = new Map(); // of those rows, by name
const shown = new Map(); // rows in the document, by name
let chosen = 0; // place of the row that the keyboard is at
let outlines = {};
let bars = [];
let offset = 0; // seconds that this machine's clock is ahead of the server's

const now = () => Date.now() / 1000 - offset;
const height = () => parseFloat(getComputedStyle($("box")).getPropertyValue("--row"));

// ---------------------------------------------------------------------- the socket

async function listen() {
  let pause = 300;
  for (;;) {
    const answer = await fetch("/api/fleet", { headers: headers(), cache: "no-store" }).catch(() => null);
    if (answer?.status === 401) return askToken(await answer.json());
    if (answer?.ok) {
      if (await follow()) pause = 300;
    }
    live("lost", "no server");
    alarm("This page's server does not answer: it has ended, or the network is gone. What is shown is of before.");
    await new Promise((done) => setTimeout(done, pause));
    pause = Math.min(3000, pause * 2);
  }
}

// Follow the server until the link is gone; whether anything came.
function follow() {
  return new Promise((done) => {
    let came = false;
    let watchdog = null;
    const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/table`;
    const link = new WebSocket(url, token() ? [PROTOCOL, `bearer.${token()}`] : [PROTOCOL]);
    const alive = () => {
      clearTimeout(watchdog);
      watchdog = setTimeout(() => link.close(), SILENT_MS);
    };
    alive();
    link.onopen = () => {
      socket = link;
      [said, table, fields, bars] = ["", { found: table.found, first: 0, names: [] }, new Map(), []];
      sight();
    };
    link.onmessage = async ({ data }) => {
      alive();
      if (!came) {
        came = true;
        live("live", "live");
        alarm("");
        $("main").hidden = false;
        sight();
      }
      take(JSON.parse(data));
      await painted();
      if (link.readyState === WebSocket.OPEN) link.send("next");
    };
    link.onclose = () => {
      clearTimeout(watchdog);
      socket = null;
      done(came);
    };
  });
}

// A page that nobody sees paints nothing, but goes on.
const painted = () => Promise.race([new Promise(requestAnimationFrame), new Promise((done) => setTimeout(done, 300))]);

function alarm(text) {
  $("alarm").hidden = !text || !$("gate").hidden;
  setText("alarm", text);
  $("main").classList.toggle("stale", Boolean(text));
}

// Tell the server which rows are in sight, if it does not know.
function sight() {
  if (socket?.readyState !== WebSocket.OPEN) return;
  const { scrollTop, clientHeight } = $("box");
  const top = Math.floor(scrollTop / height());
  const count = Math.min(MAX_ROWS, Math.ceil(clientHeight / height()) + 2 * AHEAD);
  const first = Math.max(0, top - AHEAD);
  const before = said ? JSON.parse(said) : null;
  const same = before && ["search", "filter", "sort", "descending", "count"].every((key) => before[key] === { ...wanted, count }[key]);
  if (same && Math.abs(before.first - first) < AHEAD / 2) return;
  said = JSON.stringify({ ...wanted, first, count });
  socket.send(said);
}

// ---------------------------------------------------------------------- what it tells

function take(news) {
  if (news.now) offset = Date.now() / 1000 - news.now;
  if (news.fleet !== undefined) {
    outlines = news.outlines;
    takeUnits(news.units, () => {
      for (const [name, row] of shown) if (fields.has(name)) row.show(fields.get(name), outlines, now());
    });
    setText("name", news.fleet);
  }
  if (news.totals) showTotals(news.totals);
  for (const one of news.rows ?? []) fields.set(one.name, one);
  if (news.names) {
    table = { found: news.found, first: news.first, names: news.names };
    const there = new Set(news.names);
    for (const name of fields.keys()) if (!there.has(name)) fields.delete(name);
    place();
  }
  for (const one of news.rows ?? []) shown.get(one.name)?.show(one, outlines, now());
  if (news.bars) {
    bars = [...bars, ...news.bars].slice(-120);
    drawChart($("chart"), bars, now());
  }
}

function showTotals(totals) {
  const cell = ([key, label]) => make("div", { "data-total": key, "data-bad": String(key === "failures" && totals[key] > 0) },
    make("dt", { textContent: label }), make("dd", { textContent: totals[key].toLocaleString("en") }));
  $("totals").replaceChildren(...Object.entries(TOTALS).map(cell));
  for (const chip of $("chips").children) {
    const key = chip.dataset.filter;
    chip.querySelector("b").textContent = (key === "all" ? totals.cameras : totals[key]).toLocaleString("en");
  }
}

// ---------------------------------------------------------------------- the table

// Have the rows of the table's window in the document, each at its place.
function place() {
  const high = height();
  $("tall").style.height = `${table.found * high}px`;
  $("grid").setAttribute("aria-rowcount", table.found + 1);
  $("none").hidden = table.found > 0;
  setText("found", table.found === 1 ? "1 camera" : `${table.found.toLocaleString("en")} cameras`);
  const there = new Set(table.names);
  for (const [name, row] of shown) {
    if (there.has(name)) continue;
    row.element.remove();
    shown.delete(name);
  }
  table.names.forEach((name, index) => {
    let row = shown.get(name);
    if (!row) {
      row = new Row(name);
      shown.set(name, row);
      const known = fields.get(name);
      if (known) row.show(known, outlines, now());
      $("tall").append(row.element);
    }
    row.put(table.first + index, high);
  });
  choose(Math.min(chosen, Math.max(0, table.found - 1)), false);
}

function choose(index, scroll = true) {
  chosen = index;
  const name = table.names[chosen - table.first];
  for (const [each, row] of shown) row.choose(each === name && document.activeElement === $("grid"));
  if (name) $("grid").setAttribute("aria-activedescendant", shown.get(name).element.id);
  else $("grid").removeAttribute("aria-activedescendant");
  if (!scroll) return;
  const [top, high, box] = [chosen * height(), height(), $("box")];
  if (top < box.scrollTop) box.scrollTop = top;
  else if (top + high > box.scrollTop + box.clientHeight) box.scrollTop = top + high - box.clientHeight;
}

const page = () => Math.max(1, Math.floor($("box").clientHeight / height()) - 1);
const KEYS = {
  ArrowDown: () => chosen + 1,
  ArrowUp: () => chosen - 1,
  PageDown: () => chosen + page(),
  PageUp: () => chosen - page(),
  Home: () => 0,
  End: () => table.found - 1,
};

$("grid").addEventListener("keydown", (event) => {
  if (event.target !== $("grid") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Enter") shown.get(table.names[chosen - table.first])?.open();
  else if (KEYS[event.key]) choose(Math.max(0, Math.min(table.found - 1, KEYS[event.key]())));
  else return;
  event.preventDefault();
});
$("box").addEventListener("focus", () => $("grid").focus({ preventScroll: true })); // a click, or a browser whose keys go to what scrolls
for (const kind of ["focus", "blur"]) $("grid").addEventListener(kind, () => choose(chosen, false));
$("box").addEventListener("scroll", () => requestAnimationFrame(sight), { passive: true });
addEventListener("resize", () => {
  place();
  sight();
  drawChart($("chart"), bars, now());
});
document.addEventListener("keydown", (event) => {
  if (event.key !== "/" || /^(INPUT|SELECT)$/.test(document.activeElement.tagName)) return;
  event.preventDefault();
  $("search").focus();
});

// ---------------------------------------------------------------------- which, and in which order

// What is wanted stands in the address, so that going back to this page finds it again.
function want(changes) {
  wanted = { ...wanted, ...changes };
  $("box").scrollTop = 0;
  chosen = 0;
  const query = new URLSearchParams();
  if (wanted.search) query.set("search", wanted.search);
  if (wanted.filter !== "all") query.set("filter", wanted.filter);
  if (wanted.sort !== "name" || wanted.descending) query.set("sort", `${wanted.descending ? "-" : ""}${wanted.sort}`);
  history.replaceState(null, "", String(query) ? `/?${query}` : "/");
  showWanted();
  sight();
}

function showWanted() {
  for (const chip of $("chips").children) chip.setAttribute("aria-pressed", String(chip.dataset.filter === wanted.filter));
  for (const head of $("heads").children) {
    if (!head.dataset.sort) continue;
    if (head.dataset.sort === wanted.sort) head.setAttribute("aria-sort", wanted.descending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  }
  $("sort").value = wanted.sort;
  if (document.activeElement !== $("search")) $("search").value = wanted.search;
}

const sortBy = (key) => want(key === wanted.sort ? { descending: !wanted.descending } : { sort: key, descending: DOWN.has(key) });

function begin() {
  const query = new URLSearchParams(location.search);
  const sort = query.get("sort") ?? "name";
  const [key, descending] = [sort.replace(/^-/, ""), sort.startsWith("-")];
  wanted.search = (query.get("search") ?? "").slice(0, 100);
  if (FILTERS[query.get("filter")]) wanted.filter = query.get("filter");
  if (SORTS[key]) Object.assign(wanted, { sort: key, descending });
  const chip = ([name, label]) => make("button", { type: "button", "data-filter": name, onclick: () => want({ filter: name }) }, label, make("b"));
  $("chips").replaceChildren(...Object.entries(FILTERS).map(chip));
  const head = ([name, label, number]) => make("div", { role: "columnheader", className: number ? "number" : "", "data-sort": name || null },
    name ? make("button", { type: "button", textContent: label, onclick: () => sortBy(name) }) : label);
  $("heads").replaceChildren(...COLUMNS.map(head));
  $("sort").replaceChildren(...Object.entries(SORTS).map(([name, label]) => make("option", { value: name, textContent: label })));
  $("sort").addEventListener("change", () => want({ sort: $("sort").value, descending: DOWN.has($("sort").value) }));
  let pause = null;
  $("search").addEventListener("input", () => {
    clearTimeout(pause);
    pause = setTimeout(() => want({ search: $("search").value.trim() }), 150);
  });
  drawLegend($("legend"));
  showWanted();
}

begin();
const address = `${location.pathname}${location.search}`;
atGate(listen);
history.replaceState(null, "", address);
setInterval(() => {
  for (const row of shown.values()) row.age(now());
  if (bars.length && Math.floor(now()) % 5 === 0) drawChart($("chart"), bars, now());
}, 1000);
followOutlets();
listen();
