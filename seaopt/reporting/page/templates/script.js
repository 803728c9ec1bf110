"use strict";
// Reading and zooming of drawings that are complete without it. A curve's points are those of its path in the SVG, whose
// coordinates are an affine (on logarithmic axes: after a logarithm) function of the data: zooming is affine too.
const SVG = "http://www.w3.org/2000/svg";
const TICKS = { x: 6, y: 5 };
const FEWEST_PIXELS = 6; // a smaller frame is a click
const LARGEST_ZOOM = 2000;

const make = (name, attributes, parent) => {
  const node = document.createElementNS(SVG, name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  parent.append(node);
  return node;
};
const format = (value, step = 0) => {
  if (value === 0 || (step && Math.abs(value) < step * 1e-6)) return "0";
  const digits = step ? Math.max(1, Math.ceil(Math.log10(Math.abs(value) / step)) + 1) : 5;
  const text = Number(value.toPrecision(Math.min(digits, 12)));
  return Math.abs(text) >= 1e6 || Math.abs(text) < 1e-4 ? text.toExponential().replace("e+", "e") : String(text);
};

// One side of axes: data to a fraction of its length, and the part [from, to] of that which is seen.
class Side {
  constructor({ low, high, log, label }) {
    const f = log ? Math.log10 : (value) => value;
    Object.assign(this, { log, label, a: f(low), b: f(high), from: 0, to: 1 });
  }
  value(fraction) {
    const inner = this.a + fraction * (this.b - this.a);
    return this.log ? 10 ** inner : inner;
  }
  fraction(value) { return ((this.log ? Math.log10(value) : value) - this.a) / (this.b - this.a); }
  seen(fraction) { return (fraction - this.from) / (this.to - this.from); }
  get whole() { return this.from === 0 && this.to === 1; }
  see(from, to) {
    const width = Math.min(1, Math.max(to - from, 1 / LARGEST_ZOOM));
    this.from = Math.min(Math.max(0, (from + to - width) / 2), 1 - width);
    this.to = this.from + width;
    if (width > 0.9999) { this.from = 0; this.to = 1; }
  }
  ticks(count) {
    const [low, high] = [this.value(this.from), this.value(this.to)].sort((p, q) => p - q);
    if (this.log && high / low > 3) {
      const marks = [];
      const steps = high / low > 1e3 ? [1] : [1, 2, 5];
      const stride = Math.max(1, Math.ceil(Math.log10(high / low) / (1.5 * count)));
      for (let decade = Math.floor(Math.log10(low)); decade <= Math.log10(high); decade += stride)
        for (const step of steps) marks.push(step * 10 ** decade);
      return marks.filter((value) => value >= low && value <= high).map((value) => [value, format(value)]);
    }
    const raw = (high - low) / count, size = 10 ** Math.floor(Math.log10(raw));
    const step = size * [1, 2, 5, 10].find((factor) => factor * size >= raw);
    const marks = [];
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) marks.push([k * step, format(k * step, step)]);
    return marks;
  }
}

// One pair of axes in a drawing.
class Pane {
  constructor(svg, name, number, { box, x, y, curves }) {
    this.box = box; this.x = new Side(x); this.y = new Side(y);
    this.group = svg.getElementById(`${name}-pane${number}`);
    this.ticks = [...this.group.querySelectorAll('[id*="-xtick_"], [id*="-ytick_"]')];
    const own = (node) => !this.ticks.some((tick) => tick.contains(node)) && !node.closest("defs, clipPath");
    this.paths = [...this.group.querySelectorAll("[clip-path]")].filter(own).flatMap((node) => {
      const paths = node.tagName === "path" ? [node] : [];
      for (const path of paths) { // the clip must not move with what it clips: it goes on a group around
        const holder = document.createElementNS(SVG, "g");
        holder.setAttribute("clip-path", path.getAttribute("clip-path"));
        path.replaceWith(holder); path.removeAttribute("clip-path"); holder.append(path);
      }
      return paths;
    }).map((node) => ({ node, parts: node.getAttribute("d").match(/[MLCQZz][^MLCQZz]*/g).map((part) =>
      [part[0], (part.slice(1).match(/-?[\d.]+(?:e[+-]?\d+)?/g) || []).map(Number)]) }));
    this.marks = [...this.group.querySelectorAll("use")].filter(own).filter((node) => node.hasAttribute("x")).map((node) =>
      ({ node, at: [Number(node.getAttribute("x")), Number(node.getAttribute("y"))] }));
    this.curves = curves.map((curve) => this.read(svg.getElementById(`${name}-${curve.id}`), curve.label)).filter(Boolean);
    this.layer = make("g", {}, this.group);
  }
  read(node, label) {
    if (!node) return null;
    const path = this.paths.find((one) => node.contains(one.node));
    const points = path ? path.parts.filter(([, at]) => at.length >= 2).map(([, at]) => at.slice(-2))
      : this.marks.filter((mark) => node.contains(mark.node)).map((mark) => mark.at);
    const shown = path ? path.node : node.querySelector("use");
    return points.length ? { node, points, label, colour: shown ? getComputedStyle(shown)[path ? "stroke" : "fill"] : "" } : null;
  }
  // From a point of the drawing at rest to where it is now, and from a fraction of the box to a point.
  move([px, py]) {
    const [left, top, right, bottom] = this.box;
    return [left + this.x.seen((px - left) / (right - left)) * (right - left),
      bottom - this.y.seen((bottom - py) / (bottom - top)) * (bottom - top)];
  }
  values([px, py]) {
    const [left, top, right, bottom] = this.box;
    return [this.x.value((px - left) / (right - left)), this.y.value((bottom - py) / (bottom - top))];
  }
  holds([px, py], slack = 0) {
    const [left, top, right, bottom] = this.box;
    return px >= left - slack && px <= right + slack && py >= top - slack && py <= bottom + slack;
  }
  draw() {
    for (const { node, parts } of this.paths) {
      node.setAttribute("d", parts.map(([letter, at]) => {
        const out = [];
        for (let k = 0; k + 1 < at.length; k += 2) out.push(...this.move([at[k], at[k + 1]]).map((value) => value.toFixed(2)));
        return letter + out.join(" ");
      }).join(""));
    }
    for (const { node, at } of this.marks) {
      const place = this.move(at);
      node.setAttribute("x", place[0]); node.setAttribute("y", place[1]);
      node.classList.toggle("off", !this.holds(place, 4));
    }
    this.layer.replaceChildren();
    for (const node of this.ticks) {
      const side = node.id.includes("-xtick_") ? this.x : this.y;
      node.classList.toggle("off", !side.whole);
    }
    const [left, top, right, bottom] = this.box;
    const bare = this.ticks.filter((node) => node.id.includes("-xtick_")).every((node) => !node.querySelector("text"));
    if (!this.x.whole) for (const [value, text] of this.x.ticks(TICKS.x)) {
      const at = left + this.x.seen(this.x.fraction(value)) * (right - left);
      make("line", { class: "tick", x1: at, x2: at, y1: top, y2: bottom }, this.layer);
      if (!bare) make("text", { x: at, y: bottom + 12.5, "text-anchor": "middle", style: "font-size:9px" }, this.layer).textContent = text;
    }
    if (!this.y.whole) for (const [value, text] of this.y.ticks(TICKS.y)) {
      const at = bottom - this.y.seen(this.y.fraction(value)) * (bottom - top);
      make("line", { class: "tick", x1: left, x2: right, y1: at, y2: at }, this.layer);
      make("text", { x: left - 5, y: at + 3.2, "text-anchor": "end", style: "font-size:9px" }, this.layer).textContent = text;
    }
    this.group.insertBefore(this.layer, this.group.firstChild);
  }
}

const charts = [];

class Chart {
  constructor(plot) {
    this.plot = plot; this.svg = plot.querySelector("svg"); this.figure = plot.closest("figure");
    this.link = plot.dataset.link; this.hover = plot.dataset.hover;
    const name = this.figure.id.replace(/^fig-/, "");
    this.panes = JSON.parse(plot.dataset.axes).map((axes, number) => new Pane(this.svg, name, number, axes));
    this.over = make("g", {}, this.svg);
    this.readout = document.createElement("div");
    this.readout.className = "readout off"; this.readout.setAttribute("role", "status");
    plot.append(this.readout);
    this.listen();
    charts.push(this);
  }
  point(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [at.x, at.y];
  }
  pane(at) { return this.panes.find((pane) => pane.holds(at)); }
  listen() {
    const { svg, plot } = this;
    let start = null, pending = 0;
    svg.addEventListener("pointerdown", (event) => {
      const at = this.point(event);
      this.showTools();
      if (event.button !== 0 || !this.pane(at)) return;
      if (event.pointerType === "touch") { this.show(at); return; }
      start = { at, pane: this.pane(at) };
      svg.setPointerCapture(event.pointerId);
      event.preventDefault(); plot.focus({ preventScroll: true });
    });
    svg.addEventListener("pointermove", (event) => {
      const at = this.point(event);
      if (start) { this.frame(start, at); return; }
      cancelAnimationFrame(pending);
      pending = requestAnimationFrame(() => this.show(at));
    });
    svg.addEventListener("pointerup", (event) => {
      if (!start) return;
      this.zoomTo(start, this.point(event)); start = null;
    });
    svg.addEventListener("pointercancel", () => { start = null; this.hide(); });
    plot.addEventListener("pointerleave", () => { cancelAnimationFrame(pending); if (!start) this.hide(); });
    svg.addEventListener("dblclick", () => this.reset());
    this.figure.addEventListener("pointerenter", () => this.showTools());
    plot.addEventListener("focus", () => this.showTools());
    plot.addEventListener("blur", () => this.hide());
    plot.addEventListener("keydown", (event) => this.press(event));
  }
  press(event) {
    const steps = { ArrowLeft: -0.01, ArrowRight: 0.01, PageUp: -0.1, PageDown: 0.1 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in steps) {
      this.place = Math.min(1, Math.max(0, (this.place ?? 0.5) + steps[event.key]));
      const [left, top, right, bottom] = this.panes[0].box;
      this.show([left + this.place * (right - left), (top + bottom) / 2]);
    } else if (event.key === "+" || event.key === "=") this.zoomBy(0.5);
    else if (event.key === "-") this.zoomBy(2);
    else if (event.key === "Escape" || event.key === "0") { this.reset(); this.hide(); } else return;
    event.preventDefault();
  }
  frame({ at, pane }, now) {
    const [left, top, right, bottom] = pane.box;
    const clip = (value, low, high) => Math.min(Math.max(value, low), high);
    const [x, y] = [clip(now[0], left, right), clip(now[1], top, bottom)];
    const flat = Math.abs(y - at[1]) < 3 * FEWEST_PIXELS, thin = Math.abs(x - at[0]) < 2 * FEWEST_PIXELS;
    const [x0, x1] = thin && !flat ? [left, right] : [Math.min(x, at[0]), Math.max(x, at[0])];
    const [y0, y1] = flat ? [top, bottom] : [Math.min(y, at[1]), Math.max(y, at[1])];
    this.hide();
    make("rect", { class: "frame", x: x0, y: y0, width: x1 - x0, height: y1 - y0 }, this.over);
    return [x0, y0, x1, y1];
  }
  zoomTo(start, now) {
    const { at, pane } = start, [left, top, right, bottom] = pane.box;
    const [x0, y0, x1, y1] = this.frame(start, now);
    this.hide();
    if (Math.max(Math.abs(now[0] - at[0]), Math.abs(now[1] - at[1])) < FEWEST_PIXELS) { this.show(now); return; }
    const part = (side, low, high) => [side.from + low * (side.to - side.from), side.from + high * (side.to - side.from)];
    const across = part(pane.x, (x0 - left) / (right - left), (x1 - left) / (right - left));
    pane.y.see(...part(pane.y, (bottom - y1) / (bottom - top), (bottom - y0) / (bottom - top)));
    this.seeX(pane, across);
  }
  // The same part of x on every pane of this chart, and the same values on every chart that is linked.
  seeX(pane, [from, to]) {
    const low = pane.x.value(from), high = pane.x.value(to);
    for (const chart of charts.filter((one) => one === this || (this.link && one.link === this.link))) {
      for (const each of chart.panes) {
        const [p, q] = [each.x.fraction(low), each.x.fraction(high)];
        if (chart === this) each.x.see(from, to); else if (p < 1 && q > 0) each.x.see(Math.max(p, 0), Math.min(q, 1));
      }
      chart.draw();
    }
  }
  zoomBy(factor) {
    const pane = this.panes[0], middle = pane.x.from + (this.place ?? 0.5) * (pane.x.to - pane.x.from);
    const half = factor * (pane.x.to - pane.x.from) / 2;
    this.seeX(pane, [Math.max(0, middle - half), Math.min(1, middle + half)]);
  }
  reset() {
    for (const pane of this.panes) pane.y.see(0, 1);
    for (const chart of charts.filter((one) => one === this || (this.link && one.link === this.link))) {
      for (const pane of chart.panes) pane.x.see(0, 1);
      chart.draw();
    }
  }
  draw() { this.hide(); for (const pane of this.panes) pane.draw(); }
  hide() { this.over.replaceChildren(); this.readout.classList.add("off"); }
  showTools() {
    if (tools.parentNode === this.figure) return;
    this.figure.append(tools);
    tools.chart = this;
  }
  // Mark what lies under the pointer, and write its values.
  show(at) {
    const pane = this.pane(at);
    this.hide();
    if (!pane) return;
    const [left, , right] = pane.box;
    this.place = (at[0] - left) / (right - left);
    const rows = [];
    for (const each of this.hover === "point" ? [pane] : this.panes) {
      if (this.hover !== "point") make("line", { class: "cross", x1: at[0], x2: at[0], y1: each.box[1], y2: each.box[3] }, this.over);
      let nearest = null;
      for (const curve of each.curves) {
        if (curve.node.classList.contains("off")) continue;
        let best = null, least = Infinity;
        for (const point of curve.points) {
          const [px, py] = each.move(point);
          const away = this.hover === "point" ? Math.hypot(px - at[0], py - at[1]) : Math.abs(px - at[0]);
          if (away < least) { least = away; best = point; }
        }
        if (!best || (this.hover !== "point" && least > 25) || !each.holds([each.move(best)[0], (each.box[1] + each.box[3]) / 2], 1)) continue;
        const row = { pane: each, curve, point: best, least };
        if (this.hover !== "point") rows.push(row); else if (!nearest || least < nearest.least) nearest = row;
      }
      if (nearest) rows.push(nearest);
    }
    if (rows.length) this.write(rows, at);
  }
  write(rows, at) {
    const name = (label) => /^(.*?)\s*\[(.*)\]$/.exec(label) || [label, label, ""];
    const line = (colour, text) => {
      const row = document.createElement("div");
      if (colour) { const dot = document.createElement("i"); dot.style.background = colour; row.append(dot); }
      row.append(text); this.readout.append(row);
    };
    const unit = (text) => (text && text !== "-" ? ` ${text}` : "");
    this.readout.replaceChildren();
    const first = rows[0], [, what, inX] = name(first.pane.x.label);
    line("", `${what} ${format(first.pane.values(first.point)[0])}${unit(inX)}`);
    for (const { pane, curve, point } of rows) {
      const place = pane.move(point), [, quantity, inY] = name(pane.y.label);
      if (pane.holds(place, 1)) make("circle", { class: "dot", cx: place[0], cy: place[1], r: 3, style: `fill:${curve.colour}` }, this.over);
      const called = curve.label && this.panes.length > 1 ? `${quantity}, ${curve.label}` : curve.label || quantity;
      line(curve.colour, `${called}: ${format(pane.values(point)[1])}${unit(inY)}`);
    }
    this.readout.classList.remove("off");
    const scale = this.svg.clientWidth / this.svg.viewBox.baseVal.width, width = this.readout.offsetWidth;
    const x = at[0] * scale + 14;
    this.readout.style.left = `${Math.max(0, x + width > this.plot.clientWidth ? at[0] * scale - 14 - width : x)}px`;
    this.readout.style.top = `${Math.max(0, at[1] * scale - this.readout.offsetHeight - 8)}px`;
  }
}

const tools = document.createElement("div");
tools.className = "tools";
for (const [text, label, act] of [["+", "Zoom in", (chart) => chart.zoomBy(0.5)], ["−", "Zoom out", (chart) => chart.zoomBy(2)],
  ["Reset", "Show all", (chart) => chart.reset()]]) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: text, title: label, tabIndex: -1 });
  button.setAttribute("aria-label", label);
  button.addEventListener("click", () => act(tools.chart));
  tools.append(button);
}

// A drawing is taken apart when it comes into view: a page has a hundred of them.
const wake = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) { wake.unobserve(entry.target); new Chart(entry.target); }
}, { rootMargin: "200px" });
for (const plot of document.querySelectorAll(".plot[data-axes]")) wake.observe(plot);

for (const button of document.querySelectorAll(".key button")) button.addEventListener("click", () => {
  const shown = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(shown));
  for (const id of button.dataset.ids.split(" ")) document.getElementById(id)?.classList.toggle("off", !shown);
});

for (const button of document.querySelectorAll(".copy")) button.addEventListener("click", async () => {
  const source = button.parentNode.querySelector("pre");
  try { await navigator.clipboard.writeText(source.textContent); } catch { // no permission, or an old browser
    getSelection().selectAllChildren(source);
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
});

const theme = document.getElementById("theme"), THEMES = ["system", "light", "dark"];
const setTheme = (chosen) => {
  if (chosen === "system") delete document.documentElement.dataset.theme; else document.documentElement.dataset.theme = chosen;
  theme.textContent = `Colours: ${chosen}`;
  theme.setAttribute("aria-label", `Colours: ${chosen}; press to change`);
  try { localStorage.setItem("seaopt-colours", chosen); } catch { /* a page from a file may have no storage */ }
};
let chosen = "system";
try { chosen = THEMES.find((name) => name === localStorage.getItem("seaopt-colours")) || chosen; } catch { /* as above */ }
setTheme(chosen);
theme.hidden = false;
theme.addEventListener("click", () => { chosen = THEMES[(THEMES.indexOf(chosen) + 1) % THEMES.length]; setTheme(chosen); });

const contents = document.querySelector("nav details"), wide = matchMedia("(min-width: 70rem)");
const unfold = () => { contents.open = wide.matches; };
unfold();
wide.addEventListener("change", unfold);
for (const link of contents.querySelectorAll("a")) link.addEventListener("click", () => { if (!wide.matches) contents.open = false; });
const links = new Map([...contents.querySelectorAll("a")].map((link) => [link.hash.slice(1), link]));
const seen = new Set();
const spy = new IntersectionObserver((entries) => {
  for (const entry of entries) { if (entry.isIntersecting) seen.add(entry.target.id); else seen.delete(entry.target.id); }
  const current = [...links.keys()].find((id) => seen.has(id));
  for (const [id, link] of links) { if (id === current) link.setAttribute("aria-current", "true"); else link.removeAttribute("aria-current"); }
}, { rootMargin: "-15% 0px -70% 0px" });
for (const id of links.keys()) spy.observe(document.getElementById(id));

addEventListener("beforeprint", () => { for (const fold of document.querySelectorAll("main details")) fold.open = true; });
