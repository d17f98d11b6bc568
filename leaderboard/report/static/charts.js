// Draws the charts of a page with Plotly; leaderboard/report/figures.py describes their data.
"use strict";

const MILLIMETRES = 0.1; // unit of encoded heights
const HALF_WIDTH_90 = 1.645; // 90 % interval of a normal distribution, in standard deviations
const LEGEND = { row: 21, entry: 160 }; // height of a row and typical width of an entry [pixels]
const KEYS = { ArrowLeft: [1, -0.2], ArrowRight: [1, 0.2], "+": [0.5, 0], "=": [0.5, 0], "-": [2, 0] };
const FONT = { family: "system-ui, sans-serif", size: 13, color: "var(--ink)" };
const AXIS = {
  automargin: true, title: { standoff: 6, font: FONT }, gridcolor: "var(--rule)", zerolinecolor: "var(--rule)", linecolor: "var(--faint)",
  tickfont: { color: "var(--quiet)" },
};
const LAYOUT = {
  height: 340, font: FONT, paper_bgcolor: "var(--card)", plot_bgcolor: "var(--card)",
  margin: { l: 56, r: 16, t: 34, b: 44 }, hovermode: "closest", dragmode: "zoom",
  hoverlabel: { bgcolor: "var(--card)", bordercolor: "var(--faint)", font: FONT },
  legend: { orientation: "h", x: 0, yref: "container", y: 0, yanchor: "bottom" },
  modebar: { bgcolor: "rgba(0,0,0,0)", color: "var(--faint)", activecolor: "var(--ink)" },
};

/** Replace CSS variables by their values, which differ between the light and the dark page. */
function themed(figure) {
  const style = getComputedStyle(document.documentElement);
  const value = (_, name) => style.getPropertyValue(name).trim();
  return JSON.parse(JSON.stringify(figure).replace(/var\((--[\w-]+)\)/g, value));
}

/** Return the Plotly traces of one of ours: encoded heights become a line and its 90 % band. */
function decoded({ dy, std, ...trace }) {
  if (!dy) return [trace];
  let sum = 0;
  const y = dy.map((step) => (sum += step) * MILLIMETRES);
  const line = { ...trace, y };
  if (!std) return [line];
  const x = y.map((_, k) => trace.x0 + k * trace.dx);
  const reach = std.map((size) => HALF_WIDTH_90 * size * MILLIMETRES);
  const edge = (sign) => y.map((z, k) => z + sign * reach[k]);
  const { name, legendgroup, visible } = trace;
  const band = {
    name, legendgroup, visible, x: [...x, ...x.toReversed()], y: [...edge(1), ...edge(-1).toReversed()],
    mode: "lines", fill: "toself", fillcolor: trace.line.color + "2e", line: { width: 0 },
    hoverinfo: "skip", showlegend: false,
  };
  return [band, line];
}

function withAxes(layout) {
  const found = { ...LAYOUT, ...layout };
  for (const name of ["xaxis", "yaxis", ...Object.keys(layout).filter((key) => /^[xy]axis/.test(key))]) {
    found[name] = { ...AXIS, ...layout[name], title: { ...AXIS.title, ...layout[name]?.title } };
  }
  return found;
}

class Chart {
  constructor(host) {
    this.host = host;
    const { chart, source = chart, by } = host.dataset; // two charts may share their data
    this.data = JSON.parse(document.getElementById(`chart-${source}`).textContent);
    this.fields = (by?.split(" ") ?? this.data.by).map((name) => document.querySelector(`[name="${name}"]`));
    this.caption = document.querySelector(`[data-caption="${host.dataset.chart}"]`);
    this.resets = 0;
    host.setAttribute("aria-label", this.data.title);
    for (const field of this.fields) field.addEventListener("input", () => this.draw());
    host.addEventListener("keydown", (event) => this.press(event));
    host.addEventListener("pointerdown", () => host.focus({ preventScroll: true }), { capture: true });
    // the wheel scrolls the page, unless the chart was clicked or Ctrl is held
    host.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== host) event.stopPropagation();
    }, { capture: true });
  }

  /** Return the layout of a figure, higher by the rows of its legend. */
  layout(figure) {
    const layout = withAxes({ ...this.data.layout, ...figure.layout });
    const entries = layout.showlegend === false ? 0 : figure.data.filter((trace) => trace.showlegend !== false).length;
    const rows = Math.ceil((entries * LEGEND.entry) / Math.max(this.host.clientWidth - 70, LEGEND.entry));
    layout.margin = { ...layout.margin, b: layout.margin.b + rows * LEGEND.row };
    layout.height += Math.max(rows - 1, 0) * LEGEND.row;
    return layout;
  }

  draw() {
    const figure = this.data.figures[this.fields.map((field) => field.value).join("|")];
    if (!figure) return Plotly.purge(this.host);
    const layout = this.layout(figure);
    // zoom and hidden lines survive another figure of the chart, but not a reset
    const before = this.host.layout?.uirevision === this.resets ? this.host.data : [];
    const visible = new Map(before.map((trace) => [trace.name, trace.visible ?? true]));
    layout.uirevision = this.resets;
    const drawn = themed({ data: figure.data.flatMap(decoded), layout });
    for (const trace of drawn.data) trace.visible = visible.get(trace.name) ?? trace.visible;
    Plotly.react(this.host, drawn.data, drawn.layout, {
      responsive: true, displaylogo: false, scrollZoom: true, showSendToCloud: false, plotlyServerURL: "",
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
      toImageButtonOptions: { filename: `road-recon-${this.host.dataset.chart}`, scale: 2 },
    });
    this.host.removeAllListeners("plotly_click");
    this.host.on("plotly_click", ({ points }) => {
      const target = points[0].customdata;
      if (typeof target === "string" && target.startsWith("#")) location.hash = target;
    });
    if (this.caption) this.caption.textContent = figure.caption ?? "";
  }

  /** Arrow keys move along x, + and - zoom, Home shows all, digits show and hide lines. */
  press(event) {
    const move = KEYS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Home") {
      this.resets += 1;
      this.draw();
    } else if (/^[1-9]$/.test(event.key)) this.toggle(Number(event.key) - 1);
    else if (move) {
      const [low, high] = this.host._fullLayout.xaxis.range.map(Number);
      const [middle, half] = [(low + high) / 2 + move[1] * (high - low), (move[0] * (high - low)) / 2];
      Plotly.relayout(this.host, { "xaxis.range": [middle - half, middle + half] });
    } else return;
    event.preventDefault();
  }

  toggle(number) {
    const traces = this.host.data;
    const group = [...new Set(traces.map((trace) => trace.legendgroup).filter(Boolean))][number];
    const members = traces.flatMap((trace, k) => (trace.legendgroup === group ? [k] : []));
    if (!group) return;
    const visible = (traces[members[0]].visible ?? true) === true ? "legendonly" : true;
    Plotly.restyle(this.host, { visible }, members);
  }
}

const charts = [...document.querySelectorAll("[data-chart]")].map((host) => new Chart(host));
const drawAll = () => charts.forEach((chart) => chart.draw());
drawAll();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
document.documentElement.dataset.ready = "yes";
