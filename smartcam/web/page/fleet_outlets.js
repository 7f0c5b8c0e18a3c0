// Outlets on the fleet's page: their counts, and what the stores of results say of a shift.

import { $, headers, make, setText } from "./base.js";

const PERIOD_MS = 5000; // between two questions for the counts
const NUMBERS = ["results", "delivered", "spooled"];

const ask = async (path) => {
  const answer = await fetch(path, { headers: headers(), cache: "no-store" }).catch(() => null);
  return answer?.ok ? answer.json() : null;
};

// Show the counts from now on; the panel is there as soon as an agent tells of an outlet.
export async function followOutlets() {
  $("failures").addEventListener("toggle", showFailures);
  $("since").addEventListener("change", showFailures);
  for (;;) {
    const said = document.hidden ? null : await ask("/api/outlets");
    if (said) showCounts(said.outlets);
    await new Promise((done) => setTimeout(done, PERIOD_MS));
  }
}

function showCounts(outlets) {
  $("outlets").hidden = !outlets.length;
  $("outlet-counts").replaceChildren(...outlets.map(countsRow));
}

function countsRow(one) {
  const dropped = Object.entries(one.dropped).map(([why, count]) => `${count} ${why}`);
  const numbers = NUMBERS.map((name) => cell(one[name], name));
  const cells = [cell(one.agent), cell(one.outlet), ...numbers, cell(dropped.join(", ") || "0", "dropped"), cell(one.trouble || "well")];
  return make("tr", { "data-well": String(!one.trouble) }, ...cells);
}

async function showFailures() {
  if (!$("failures").open) return;
  const said = await ask(`/api/stored?failed=true&hours=${$("since").value}`);
  const stores = said?.stores ?? [];
  setText("counted", stores.map(counted).join(" "));
  const rows = stores.flatMap((store) => store.rows).sort((one, other) => (one.at < other.at ? 1 : -1));
  $("failed").replaceChildren(...rows.map(failure));
}

function counted(store) {
  if (store.error) return `${store.agent}: ${store.error}.`;
  const least = store.at_least ? "at least " : "";
  return `${store.agent} ${store.outlet}: ${store.failed} of ${store.total} failed, ${store.errors} errors, ${least}${store.lost} lost in ${store.gaps} gaps.`;
}

function failure(row) {
  const cells = [new Date(row.at).toLocaleString(), row.camera || "all cameras", row.application ?? "", row.error || row.value || ""];
  return make("tr", {}, ...cells.map((text) => cell(text)));
}

// A cell; where the table has no room for its head, the name stands in front of the text.
const cell = (text, name) => make("td", { textContent: String(text), ...(name && { "data-name": name }) });
