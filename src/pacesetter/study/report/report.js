"use strict";
// Sorting: a click on a header sorts by numbers where a column has them, by words elsewhere.
for (const table of document.querySelectorAll("table.sortable")) {
  const headers = [...table.tHead.rows[0].cells];
  const value = (row, place) => {
    const cell = row.cells[place];
    if (cell.dataset.key === undefined) return cell.textContent === "-" ? null : cell.textContent;
    return cell.dataset.key === "inf" ? Infinity : Number(cell.dataset.key);
  };
  headers.forEach((header, place) => header.firstElementChild.addEventListener("click", () => {
    const up = header.getAttribute("aria-sort") !== "ascending";
    headers.forEach((other) => other.removeAttribute("aria-sort"));
    header.setAttribute("aria-sort", up ? "ascending" : "descending");
    const order = (a, b) => {
      const [x, y] = [value(a, place), value(b, place)];
      if (x === null || y === null) return (x === null) - (y === null);
      const sign = typeof x === "number" && typeof y === "number"
        ? Math.sign(x - y) || 0 : String(x).localeCompare(String(y));
      return up ? sign : -sign;
    };
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
  }));
}
for (const cell of document.querySelectorAll("td")) {
  if (cell.textContent.length > 25 && !cell.querySelector("small")) cell.classList.add("long");
}

// A shadow where a table goes on beyond its right edge.
for (const inner of document.querySelectorAll(".scroll")) {
  const look = () => inner.parentElement.classList.toggle("more",
    inner.scrollLeft + inner.clientWidth < inner.scrollWidth - 2);
  inner.addEventListener("scroll", look, { passive: true });
  new ResizeObserver(look).observe(inner);
}

// Charts.
const data = JSON.parse(document.getElementById("data").textContent);
const HEIGHT = 340, LEFT = 62, RIGHT = 14, TOP = 10, BOTTOM = 46;
const shown = new Set(Object.keys(data.styles));
let axis = "steps", seeds = false;

function element(name, attributes = {}, parent = null, text = "") {
  const svg = ["svg", "path", "line", "text", "g", "circle", "rect"].includes(name);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", name)
    : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== "") made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

// Three digits and a unit; numbers of one axis share the unit of its largest.
function short(value, largest = value) {
  if (value === 0) return "0";
  const size = Math.abs(largest);
  const digits = (number) => String(Number(number.toPrecision(3)));
  if (size >= 1e9) return digits(value / 1e9) + "G";
  if (size >= 1e6) return digits(value / 1e6) + "M";
  if (size >= 1e4) return digits(value / 1e3) + "k";
  return Math.abs(value) >= 100 ? String(Math.round(value)) : digits(value);
}

function ticks(low, high, count = 5) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= raw));
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + step / 1e6; at += step) found.push(at);
  return found.map((at) => (Math.abs(at) < step / 1e6 ? 0 : at));
}

function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value === null) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low === Infinity) return [0, 1];
  return low === high ? [low - 1, high + 1] : [low, high];
}

function path(xs, ys, x, y) {
  let text = "", pen = "M";
  xs.forEach((at, place) => {
    if (ys[place] === null) { pen = "M"; return; }
    text += pen + x(at).toFixed(1) + " " + y(ys[place]).toFixed(1);
    pen = "L";
  });
  return text;
}

class Chart {
  constructor(spec, parent) {
    this.spec = spec;
    const box = element("figure", { class: "chart" }, parent);
    element("h3", {}, box, spec.title);
    this.svg = element("svg", {
      height: HEIGHT, tabindex: "0", role: "img",
      "aria-label": `${spec.title}: ${spec.y}. Left and right arrow keys read the values.`,
    }, box);
    this.values = element("p", { class: "values", "aria-live": "polite" }, box);
    this.svg.addEventListener("pointermove", (event) => this.follow(event));
    this.svg.addEventListener("pointerdown", (event) => this.follow(event));
    this.svg.addEventListener("pointerleave", () => this.read(null));
    this.svg.addEventListener("blur", () => this.read(null));
    this.svg.addEventListener("keydown", (event) => this.step(event));
  }

  draw() {
    const spec = this.spec;
    this.width = Math.max(this.svg.clientWidth, 240);
    this.axis = spec.axes[axis] === undefined ? Object.keys(spec.axes)[0] : axis;
    this.lines = Object.entries(spec.lines[this.axis]).filter(([name]) => shown.has(name));
    const single = seeds ? this.lines.flatMap(([name]) => (spec.seeds[name] || [])
      .map((seed) => [name, seed[this.axis], seed.y])) : [];
    const xs = this.lines.flatMap(([, line]) => line[0]).concat(single.flatMap((one) => one[1]));
    const means = this.lines.flatMap(([, line]) => line[1])
      .concat(single.flatMap((one) => one[2]));
    const bands = this.lines.flatMap(([, line]) => [...line[2], ...line[3]]);
    [this.low, this.high] = extent(xs);
    // The interval of two seeds can be ten times as wide as all else: no more than its height again.
    const [least, most] = extent(means), [lowest, highest] = extent(means.concat(bands));
    const bottom = Math.max(lowest, 2 * least - most), top = Math.min(highest, 2 * most - least);
    const pad = (top - bottom) * 0.04;
    this.x = (at) => LEFT + (at - this.low) / (this.high - this.low) * (this.width - LEFT - RIGHT);
    this.y = (at) => TOP + (top + pad - at) / (top - bottom + 2 * pad) * (HEIGHT - TOP - BOTTOM);
    this.svg.replaceChildren();
    this.frame(bottom - pad, top + pad);
    for (const [name, x, y] of single) this.stroke(name, x, y, 0.35, 1);
    for (const [name, line] of this.lines) this.band(name, line);
    for (const [name, line] of this.lines) this.stroke(name, line[0], line[1], 1, 2.2);
    this.cursor = element("g", { "aria-hidden": "true" }, this.svg);
    this.read(null);
  }

  frame(bottom, top) {
    const reach = Math.max(Math.abs(bottom), Math.abs(top));
    for (const at of ticks(bottom, top)) {
      const y = this.y(at);
      element("line", { class: "grid", x1: LEFT, x2: this.width - RIGHT, y1: y, y2: y }, this.svg);
      element("text", { x: LEFT - 6, y: y + 4, "text-anchor": "end" }, this.svg,
        short(at, reach));
    }
    for (const at of ticks(this.low, this.high, this.width / 110)) {
      const x = this.x(at);
      const end = HEIGHT - BOTTOM;
      element("line", { class: "grid", x1: x, x2: x, y1: TOP, y2: end }, this.svg);
      const anchor = x > this.width - RIGHT - 16 ? "end" : "middle";
      element("text", { x, y: end + 17, "text-anchor": anchor }, this.svg, short(at, this.high));
    }
    const middle = (LEFT + this.width - RIGHT) / 2;
    element("text", { x: middle, y: HEIGHT - 8, "text-anchor": "middle" }, this.svg,
      this.spec.axes[this.axis]);
    const half = (HEIGHT - BOTTOM + TOP) / 2;
    element("text", { x: 14, y: half, "text-anchor": "middle",
      transform: `rotate(-90 14 ${half})` }, this.svg, this.spec.y);
  }

  stroke(name, xs, ys, opacity, width) {
    const [colour, dashes] = data.styles[name];
    if (xs.length === 1) {  // a line of one point is not seen
      const [cx, cy] = [this.x(xs[0]), this.y(ys[0])];
      element("circle", { cx, cy, r: 4, fill: colour, "fill-opacity": opacity }, this.svg);
    }
    element("path", { d: path(xs, ys, this.x, this.y), fill: "none", stroke: colour,
      "stroke-width": width, "stroke-opacity": opacity, "stroke-dasharray": dashes,
      "stroke-linejoin": "round" }, this.svg);
  }

  band(name, [xs, , low, high]) {
    if (low.some((value) => value === null)) return;
    const there = path(xs, high, this.x, this.y);
    const back = path([...xs].reverse(), [...low].reverse(), this.x, this.y);
    const width = this.width - LEFT - RIGHT, height = HEIGHT - TOP - BOTTOM;
    const panel = element("svg", { x: LEFT, y: TOP, width, height, class: "panel",
      viewBox: `${LEFT} ${TOP} ${width} ${height}` }, this.svg);  // which cuts what is outside
    element("path", { d: `${there}L${back.slice(1)}Z`, fill: data.styles[name][0],
      "fill-opacity": 0.16 }, panel);
  }

  follow(event) {
    const at = event.clientX - this.svg.getBoundingClientRect().left;
    this.read(this.low + (at - LEFT) / (this.width - LEFT - RIGHT) * (this.high - this.low));
  }

  step(event) {
    const way = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!way) return;
    event.preventDefault();
    const small = (this.high - this.low) / 40;
    const from = this.at === null ? (way > 0 ? this.low - small : this.high + small) : this.at;
    this.read(from + way * small);
  }

  // Show the values of all lines at a place on the x axis, or where no place is meant, at their end.
  read(at) {
    this.at = at === null ? null : Math.min(Math.max(at, this.low), this.high);
    this.cursor.replaceChildren();
    this.values.replaceChildren();
    const label = this.spec.axes[this.axis].split(":")[0];
    if (this.at !== null) {
      const x = this.x(this.at);
      element("line", { class: "cursor", x1: x, x2: x, y1: TOP, y2: HEIGHT - BOTTOM }, this.cursor);
      element("span", {}, this.values, `${label} ${short(this.at)}`);
    } else if (this.axis === "profile") {
      return;
    } else {
      element("span", {}, this.values, "at the end");
    }
    for (const [name, line] of this.lines) this.tell(name, line);
  }

  // One line's value at the place, interpolated between evaluations.
  tell(name, [xs, mean, low, high]) {
    const last = xs.length - 1, at = this.at === null ? xs[last] : this.at;
    if (at < xs[0] || at > xs[last]) return;
    const next = Math.max(1, xs.findIndex((value) => value >= at));
    const part = last ? (at - xs[next - 1]) / (xs[next] - xs[next - 1]) : 0;
    const mix = (ys) => (ys[last] === null || !last ? ys[last]
      : ys[next - 1] + part * (ys[next] - ys[next - 1]));
    const colour = data.styles[name][0];
    if (this.at !== null) {
      element("circle", { cx: this.x(at), cy: this.y(mix(mean)), r: 4, fill: colour }, this.cursor);
    }
    const words = element("span", {}, this.values);
    element("i", { style: `background:${colour}` }, words);
    const band = mix(low) === null ? "" : ` [${short(mix(low))}; ${short(mix(high))}]`;
    words.append(`${name} ${short(mix(mean))}${band}`);
  }
}

const charts = data.charts.map((spec) => new Chart(spec, document.getElementById("charts")));
const redraw = () => charts.forEach((chart) => chart.draw());

function control(parent, type, text, checked, act) {
  const label = element("label", {}, document.getElementById(parent));
  const input = element("input", { type, name: parent }, label);
  input.checked = checked;
  input.addEventListener("change", () => { act(input.checked); redraw(); });
  label.append(text);
  return label;
}

const axes = Object.assign({}, ...data.charts.map((spec) => spec.axes));
delete axes.profile;
for (const [key, text] of Object.entries(axes)) {
  control("axes", "radio", text, key === axis, () => { axis = key; });
}
for (const [name, [colour, dashes]] of Object.entries(data.styles)) {
  const label = control("names", "checkbox", name, true, (on) => {
    if (on) shown.add(name); else shown.delete(name);
  });
  const sample = element("svg", { width: 26, height: 10, "aria-hidden": "true" });
  element("line", { x1: 0, x2: 26, y1: 5, y2: 5, stroke: colour, "stroke-width": 3,
    "stroke-dasharray": dashes }, sample);
  label.insertBefore(sample, label.lastChild);
}
control("names", "checkbox", "each seed", false, (on) => { seeds = on; });
let width = 0;
new ResizeObserver(([{ contentRect }]) => {
  if (contentRect.width !== width) redraw();
  width = contentRect.width;
}).observe(document.getElementById("charts"));
redraw();
