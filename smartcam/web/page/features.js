// The features of a source's device: read when the list is opened, set where the page may.

import { headers, make } from "./base.js";

const MAX_ROWS = 1000;

export class Features {
  // path: of the source's calls.
  constructor(path) {
    this.path = path;
    this.list = make("dl", { className: "features" });
    this.why = make("p", { className: "why", role: "alert" });
    this.filter = make("input", { type: "search", placeholder: "find a feature", "aria-label": "Find a feature" });
    this.trigger = make("button", { type: "button", textContent: "Trigger", hidden: true });
    this.panel = make("details", { className: "device" }, make("summary", { textContent: "Features" }), this.trigger, this.filter, this.why, this.list);
    this.panel.addEventListener("toggle", () => this.panel.open && this.read());
    this.filter.addEventListener("input", () => this.sift());
    this.trigger.addEventListener("click", () => this.ask("trigger", {}, this.trigger));
  }

  async read() {
    const answer = await this.call(`${this.path}/features`, {});
    if (!answer) return;
    const { features, settable } = answer;
    this.trigger.hidden = !settable;
    this.list.replaceChildren(...features.slice(0, MAX_ROWS).map((one) => this.row(one, settable)));
    this.sift();
  }

  // Ask for a change, then show all as they are since: one may change others.
  async ask(what, body, element) {
    element.disabled = true;
    const done = await this.call(`${this.path}/${what}`, { method: "POST", body: JSON.stringify(body) });
    element.disabled = false;
    if (done && what !== "trigger") await this.read();
  }

  async call(path, options) {
    try {
      const response = await fetch(path, { ...options, headers: { ...headers(), "Content-Type": "application/json" }, cache: "no-store" });
      const isPicture = response.ok && response.headers.get("Content-Type") === "image/jpeg";
      const answer = isPicture ? {} : await response.json();
      this.why.textContent = response.ok ? "" : answer.error;
      return response.ok ? answer : null;
    } catch (error) {
      this.why.textContent = `The page's server does not answer: ${error.message}`;
      return null;
    }
  }

  row(feature, settable) {
    const { name, kind, access, value, entries, range, unit, description, problem } = feature;
    const can = settable && access.includes("w");
    let shown = make("output", { textContent: value === null ? problem || "-" : `${value} ${unit}` });
    if (can && kind === "command") {
      shown = make("button", { type: "button", textContent: "Execute" });
      shown.addEventListener("click", () => this.ask("command", { name }, shown));
    } else if (can) {
      shown = this.input(kind, value, entries);
      shown.setAttribute("aria-label", name);
      shown.addEventListener("change", () => this.ask("feature", { name, value: kind === "boolean" ? shown.checked : shown.value }, shown));
    }
    const about = make("small", { textContent: access ? range : "not available now" });
    return make("div", { "data-name": name.toLowerCase(), title: description }, make("dt", { textContent: name }), make("dd", {}, shown, " ", about));
  }

  input(kind, value, entries) {
    if (kind === "boolean") return make("input", { type: "checkbox", checked: value });
    if (kind !== "enumeration") return make("input", { type: "text", value: String(value ?? "") });
    return make("select", {}, ...entries.map((one) => make("option", { value: one, textContent: one, selected: one === value })));
  }

  sift() {
    const wanted = this.filter.value.trim().toLowerCase();
    for (const row of this.list.children) row.hidden = !row.dataset.name.includes(wanted);
  }
}
