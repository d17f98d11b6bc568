// Line charts in SVG: linear or logarithmic axes, bands, marks, a legend that toggles lines, values
// at the pointer, and zoom and pan by mouse, wheel and keyboard.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const DASHES = ["", "7 3", "2 3", "9 3 2 3", "4 2", "1 2", "12 4", "6 2 2 2"];
const MARGIN = { left: 52, right: 16, top: 8, bottom: 38 };

function element(name, attributes, parent) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.append(node);
  return node;
}

/** Return the map from values to pixels, with its inverse. */
function scale(low, high, from, to, log) {
  const f = log ? Math.log10 : (x) => x;
  const back = log ? (x) => 10 ** x : (x) => x;
  const [a, b] = [f(low), f(high)];
  const at = (x) => from + ((f(x) - a) / (b - a)) * (to - from);
  at.inverse = (pixel) => back(a + ((pixel - from) / (to - from)) * (b - a));
  return at;
}

function ticks(low, high, log, count) {
  if (log) {
    const from = Math.floor(Math.log10(low));
    const to = Math.ceil(Math.log10(high));
    const every = Math.max(1, Math.ceil((to - from) / count));
    const steps = to - from < count / 2 ? [1, 2, 5] : [1];
    const found = [];
    for (let k = from; k <= to; k += every) found.push(...steps.map((m) => m * 10 ** k));
    return found.filter((x) => x >= low * (1 - 1e-9) && x <= high * (1 + 1e-9));
  }
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((m) => m * power >= rough) * power;
  const found = [];
  for (let x = Math.ceil(low / step) * step; x <= high + step / 1e6; x += step) {
    found.push(Math.abs(x) < step / 1e6 ? 0 : x);
  }
  return found;
}

function shortNumber(x) {
  if (x !== 0 && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e5)) return x.toExponential(0).replace("+", "");
  return String(Number(x.toPrecision(4)));
}

class Chart {
  /** `host` is an empty element; `options` are title, axes x and y {label, log, low, high}, height, zoom. */
  constructor(host, options) {
    this.host = host;
    this.options = { height: 260, zoom: false, ...options };
    this.off = new Set();
    this.view = null;
    this.svg = element("svg", { class: "chart", role: "img", "aria-label": this.options.title });
    this.reading = document.createElement("p");
    this.reading.className = "reading";
    this.legend = document.createElement("ul");
    this.legend.className = "legend";
    host.append(this.svg, this.reading, this.legend);
    if (this.options.zoom) this.addZoom();
    this.svg.addEventListener("pointermove", (event) => this.read(event));
    new ResizeObserver(() => this.draw()).observe(host);
  }

  /** Draw lines {name, x, y, colour, dash, band?: {low, high}} and marks {x, y, kind, name, text}. */
  set(lines, { marks = [], areas = [], uprights = [] } = {}) {
    Object.assign(this, { lines, marks, areas, uprights });
    this.drawLegend();
    this.draw();
  }

  shown() {
    return this.lines.filter((line) => !this.off.has(line.name));
  }

  /** Return the full range of x. */
  fullRange() {
    const { x } = this.options;
    const lows = this.lines.map((line) => line.x[0]);
    const highs = this.lines.map((line) => line.x[line.x.length - 1]);
    return [x.low ?? Math.min(...lows), x.high ?? Math.max(...highs)];
  }

  span() {
    return this.view ?? this.fullRange();
  }

  heights([from, to]) {
    const { y } = this.options;
    if (y.low !== undefined && y.high !== undefined) return [y.low, y.high];
    let [low, high] = [Infinity, -Infinity];
    for (const line of this.shown()) {
      line.x.forEach((x, k) => {
        const value = line.y[k];
        if (x < from || x > to || value === null || (y.log && value <= 0)) return;
        low = Math.min(low, line.band ? line.band.low[k] : value);
        high = Math.max(high, line.band ? line.band.high[k] : value);
      });
    }
    if (!(high > low)) [low, high] = [low - 1 || -1, high + 1 || 1];
    const room = y.log ? 0 : 0.06 * (high - low);
    return [y.low ?? low - room, y.high ?? high + room];
  }

  draw() {
    if (!this.lines || !this.lines.length) return this.svg.replaceChildren();
    const width = Math.max(260, this.host.clientWidth);
    const height = this.options.height;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    this.svg.replaceChildren();
    const span = this.span();
    const tall = this.heights(span);
    const x = scale(...span, MARGIN.left, width - MARGIN.right, this.options.x.log);
    const y = scale(...tall, height - MARGIN.bottom, MARGIN.top, this.options.y.log);
    this.x = x;
    const clip = `clip-${this.options.id}`;
    const inside = element("clipPath", { id: clip }, element("defs", {}, this.svg));
    const box = { x: MARGIN.left, y: MARGIN.top, width: width - MARGIN.left - MARGIN.right };
    element("rect", { ...box, height: height - MARGIN.top - MARGIN.bottom }, inside);
    this.plot = element("g", { "clip-path": `url(#${clip})` }, this.svg);
    for (const area of this.areas) this.fill(area, x, y, "area");
    for (const at of this.uprights) {
      element("line", { class: "upright", x1: x(at), x2: x(at), y1: MARGIN.top, y2: height - MARGIN.bottom }, this.plot);
    }
    for (const line of this.shown()) {
      if (line.band) this.fill({ x: line.x, ...line.band, colour: line.colour }, x, y, "band");
      element("path", {
        d: this.path(line, x, y), fill: "none", stroke: line.colour, "stroke-dasharray": DASHES[line.dash % 8],
        "stroke-width": line.width ?? 1.6, "stroke-linejoin": "round",
      }, this.plot);
    }
    for (const mark of this.marks) if (!this.off.has(mark.name)) this.mark(mark, x, y);
    this.axes(span, tall, x, y, width, height);
  }

  path(line, x, y) {
    let d = "";
    let pen = "M";
    line.x.forEach((at, k) => {
      const value = line.y[k];
      if (value === null || (this.options.y.log && value <= 0)) {
        pen = "M";
        return;
      }
      d += `${pen}${x(at).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = "L";
    });
    return d;
  }

  fill(area, x, y, kind) {
    const up = area.x.map((at, k) => `${x(at).toFixed(1)} ${y(area.high[k]).toFixed(1)}`);
    const down = area.x.map((at, k) => `${x(at).toFixed(1)} ${y(area.low[k]).toFixed(1)}`).reverse();
    const shape = element("path", { class: kind, d: `M${up.concat(down).join("L")}Z` }, this.plot);
    if (area.colour) shape.setAttribute("fill", area.colour);
    if (area.letter) {
      const last = area.x.length - 1;
      const at = Math.sqrt(area.low[last] * area.high[last]);
      const place = { class: "letter", x: x(area.x[last]) + 4, y: y(at) + 4 };
      if (y(at) < this.options.height - MARGIN.bottom) element("text", place, this.svg).textContent = area.letter;
    }
  }

  mark(mark, x, y) {
    const [a, b] = [x(mark.x), y(mark.y)];
    const shapes = {
      true: `M${a - 6} ${b - 12}h12l-6 10z`, // true obstacle: triangle that points at it
      found: `M${a - 5} ${b}a5 5 0 1 0 10 0a5 5 0 1 0 -10 0`,
      missed: `M${a - 5} ${b - 5}l10 10M${a + 5} ${b - 5}l-10 10`,
      false: `M${a} ${b - 6}l6 6l-6 6l-6 -6z`,
    };
    const shape = element("path", { class: `mark ${mark.kind}`, d: shapes[mark.kind], stroke: mark.colour }, this.plot);
    element("title", {}, shape).textContent = mark.text;
  }

  axes(span, tall, x, y, width, height) {
    const bottom = height - MARGIN.bottom;
    const frame = element("g", { class: "axes" }, this.svg);
    element("path", { d: `M${MARGIN.left} ${MARGIN.top}V${bottom}H${width - MARGIN.right}` }, frame);
    for (const at of ticks(...span, this.options.x.log, width / 90)) {
      element("path", { d: `M${x(at)} ${bottom}v4` }, frame);
      element("text", { x: x(at), y: bottom + 16, "text-anchor": "middle" }, frame).textContent = shortNumber(at);
    }
    for (const at of ticks(...tall, this.options.y.log, height / 50)) {
      element("path", { class: "grid", d: `M${MARGIN.left} ${y(at)}H${width - MARGIN.right}` }, frame);
      element("text", { x: MARGIN.left - 6, y: y(at) + 4, "text-anchor": "end" }, frame).textContent = shortNumber(at);
    }
    element("text", { x: (MARGIN.left + width) / 2, y: height - 4, "text-anchor": "middle" }, frame).textContent = this.options.x.label;
    const turned = `translate(12 ${(MARGIN.top + bottom) / 2}) rotate(-90)`;
    element("text", { transform: turned, "text-anchor": "middle" }, frame).textContent = this.options.y.label;
  }

  drawLegend() {
    this.legend.replaceChildren(
      ...this.lines.map((line) => {
        const button = document.createElement("button");
        button.type = "button";
        button.setAttribute("aria-pressed", String(!this.off.has(line.name)));
        const sample = element("svg", { width: 28, height: 10, "aria-hidden": "true" });
        element("path", { d: "M0 5H28", stroke: line.colour, "stroke-width": 2, "stroke-dasharray": DASHES[line.dash % 8] }, sample);
        button.append(sample, " " + (line.label ?? line.name));
        button.addEventListener("click", () => {
          if (!this.off.delete(line.name)) this.off.add(line.name);
          button.setAttribute("aria-pressed", String(!this.off.has(line.name)));
          this.draw();
        });
        const item = document.createElement("li");
        item.append(button);
        return item;
      })
    );
  }

  read(event) {
    if (!this.x || event.buttons) return;
    const box = this.svg.getBoundingClientRect();
    const at = this.x.inverse(event.clientX - box.left);
    const values = this.shown().map((line) => {
      const k = line.x.findIndex((x) => x >= at);
      const value = k < 0 ? null : line.y[k];
      return value === null ? null : `${line.label ?? line.name} ${shortNumber(Number(value.toPrecision(3)))}`;
    });
    this.reading.textContent = `${shortNumber(Number(at.toPrecision(4)))}: ${values.filter(Boolean).join(", ")}`;
  }

  /** Zoom by `factor` about the fraction `at` of the width, and move by the fraction `by`. */
  move(factor, by, at = 0.5) {
    const [first, last] = this.fullRange();
    const [low, high] = this.span();
    const size = Math.min(last - first, Math.max((high - low) * factor, (last - first) / 200));
    const from = low + at * (high - low) - at * size + by * size;
    const start = Math.max(first, Math.min(from, last - size));
    this.view = [start, start + size];
    this.draw();
  }

  addZoom() {
    const keys = {
      ArrowLeft: [1, -0.2], ArrowRight: [1, 0.2], "+": [0.5, 0], "=": [0.5, 0], "-": [2, 0], Home: [1e6, 0],
    };
    this.svg.setAttribute("tabindex", "0");
    this.svg.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      this.move(...keys[event.key]);
    });
    this.svg.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.shiftKey && document.activeElement !== this.svg) return;
      event.preventDefault();
      const box = this.svg.getBoundingClientRect();
      this.move(event.deltaY > 0 ? 1.25 : 0.8, 0, (event.clientX - box.left) / box.width);
    }, { passive: false });
    this.svg.addEventListener("pointerdown", (event) => {
      this.drag = event.clientX;
      this.svg.setPointerCapture(event.pointerId);
    });
    this.svg.addEventListener("pointermove", (event) => {
      if (!event.buttons || this.drag === undefined) return;
      this.move(1, (this.drag - event.clientX) / this.svg.clientWidth);
      this.drag = event.clientX;
    });
  }
}
