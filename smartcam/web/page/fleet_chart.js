// The outcomes of the last ten minutes, as bars of five seconds.

import { draw } from "./base.js";

const SECONDS = 600;
const BAR = 5;
const KINDS = [["passed", "passed"], ["other", "no verdict"], ["failed", "failed"], ["errors", "errors"]];
const PLACES = { passed: 1, failed: 2, other: 3, errors: 4 }; // in a bar, behind its time

// What failed is hatched, errors have dots: they can be told apart without colours.
function patterns() {
  return draw("defs", {},
    draw("pattern", { id: "hatch", width: 4, height: 4, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" },
      draw("rect", { class: "hatch-ground", width: 4, height: 4 }), draw("line", { class: "hatch-line", x1: 0, y1: 0, x2: 0, y2: 4 })),
    draw("pattern", { id: "dots", width: 4, height: 4, patternUnits: "userSpaceOnUse" },
      draw("rect", { class: "dots-ground", width: 4, height: 4 }), draw("circle", { class: "dots-dot", cx: 2, cy: 2, r: 0.8 })));
}

export function drawLegend(element) {
  element.replaceChildren(...KINDS.map(([kind, label]) => {
    const one = document.createElement("span");
    one.append(draw("svg", { viewBox: "0 0 11 11", "aria-hidden": "true" }, draw("rect", { class: kind, width: 11, height: 11 })), label);
    return one;
  }));
}

export function drawChart(svg, bars, now) {
  const { clientWidth: width, clientHeight: height } = svg;
  if (!width) return;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const seen = bars.filter(([at]) => at > now - SECONDS);
  const sum = (bar) => bar.slice(1).reduce((total, one) => total + one, 0);
  const most = Math.max(1, ...seen.map(sum));
  const [left, low, top] = [44, height - 14, 6];
  const x = (at) => left + (1 + (at - now) / SECONDS) * (width - left);
  const wide = (BAR / SECONDS) * (width - left);
  const drawn = [patterns()];
  for (const [part, label] of [[0, "0"], [1, `${Number((most / BAR).toPrecision(3))}/s`]]) {
    const y = low - part * (low - top);
    drawn.push(draw("line", { class: "rule", x1: left, x2: width, y1: y, y2: y }), draw("text", { x: left - 5, y: y + 3, "text-anchor": "end" }, label));
  }
  for (const [minutes, anchor] of [[10, "start"], [5, "middle"], [0, "end"]]) {
    drawn.push(draw("text", { x: x(now - 60 * minutes), y: height - 2, "text-anchor": anchor }, minutes ? `−${minutes} min` : "now"));
  }
  for (const bar of seen) {
    let y = low;
    for (const [kind] of KINDS) {
      if (!bar[PLACES[kind]]) continue;
      const high = Math.max(1, (bar[PLACES[kind]] / most) * (low - top)); // one of many can be seen, too
      y -= high;
      drawn.push(draw("rect", { class: kind, x: x(bar[0]).toFixed(1), y: y.toFixed(1), width: Math.max(1, wide - 0.6).toFixed(1), height: high.toFixed(1) }));
    }
  }
  const total = (kind) => seen.reduce((all, bar) => all + bar[PLACES[kind]], 0);
  svg.setAttribute("aria-label", `Last ten minutes: ${KINDS.map(([kind, label]) => `${total(kind)} ${label}`).join(", ")}`);
  svg.replaceChildren(...drawn);
}
