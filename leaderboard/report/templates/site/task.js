// The charts of a task: along the road, over spatial frequency, over the runs.
"use strict";

const COLOURS = 7;

/** Decode heights [mm] from their differences, integers of 0.1 mm. */
function decoded(steps) {
  let sum = 0;
  return steps.map((step) => (sum += step) / 10);
}

function stations(size, ds, first) {
  return Array.from({ length: size }, (_, k) => first + k * ds);
}

function startTask() {
  const source = document.getElementById("chart-data");
  if (!source) return;
  const task = JSON.parse(source.textContent);
  const form = document.getElementById("chart-options");
  const style = Object.fromEntries(
    task.entries.map((name, k) => [name, { colour: `var(--line-${k % COLOURS})`, dash: 1 + k }])
  );
  const truth = { name: "truth", colour: "currentColor", dash: 0, width: 1.8 };
  const chart = (id, options) => new Chart(document.getElementById(id), { id, ...options });
  const road = chart("road", {
    title: "Truth and estimates along the road; arrow keys move, + and - zoom, Home shows all",
    x: { label: "distance [m]" }, y: { label: "height [mm]" }, zoom: true, height: 300,
  });
  const density = chart("density", {
    title: "Displacement spectral densities over the classes of ISO 8608",
    x: { label: "spatial frequency [cycles/m]", log: true, low: 0.05, high: 10 },
    y: { label: "density [m³]", log: true, low: 1e-9, high: 1e-1 },
  });
  const error = chart("error", {
    title: "Error over spatial frequency, with the bound",
    x: { label: "spatial frequency [cycles/m]", log: true, low: task.thirds[0], high: task.thirds[task.thirds.length - 1] },
    y: { label: "NRMSE", low: 0, high: 2 },
  });
  const runs = document.getElementById("runs")
    ? chart("runs", {
        title: "Share of runs at or below an error, with 95 % intervals",
        x: { label: task.ranks_by, low: 0, high: task.scale }, y: { label: "share of runs [%]", low: 0, high: 100 },
      })
    : null;
  const classes = task.classes.map(({ letter, low, high }) => ({ letter, x: task.class_n, low, high }));

  function drawRoad(scene, side) {
    const kind = form.elements.kind.value;
    const { ds, first } = scene[kind];
    const lines = [{ ...truth, y: decoded(scene[kind].truth[side]) }];
    for (const name of task.entries) {
      const entry = scene.entries[name];
      if (!entry) continue;
      const line = { name, ...style[name], y: decoded(entry[kind][side]) };
      if (kind === "inside" && entry.std) {
        const reach = entry.std[side].map((x) => (1.645 * x) / 10);
        line.band = { low: line.y.map((z, k) => z - reach[k]), high: line.y.map((z, k) => z + reach[k]) };
      }
      lines.push(line);
    }
    for (const line of lines) line.x = stations(line.y.length, ds, first);
    road.set(lines, { marks: kind === "raw" ? marks(scene, side) : [] });
  }

  function marks(scene, side) {
    const at = (name, kind, colour, text) => ([s, h]) => ({
      x: s, y: h / 10, name, kind, colour, text: `${name}: ${text}, ${s.toFixed(1)} m, ${(h / 10).toFixed(0)} mm`,
    });
    const marked = scene.bumps[side].map(at("truth", "true", "currentColor", "true obstacle"));
    for (const name of task.entries) {
      const entry = scene.entries[name];
      if (!entry || !entry.bumps) continue;
      const { colour } = style[name];
      marked.push(...entry.bumps[side].found.map(at(name, "found", colour, "detected")));
      marked.push(...entry.bumps[side].missed.map(at(name, "missed", colour, "missed")));
      marked.push(...entry.bumps[side].false.map(at(name, "false", colour, "false alarm")));
    }
    return marked;
  }

  function drawDensity(scene) {
    const lines = [["truth", truth, scene.density], ...task.entries.map((name) => [name, style[name], scene.entries[name]?.density])];
    const drawn = lines.filter(([, , density]) => density);
    density.set(
      drawn.map(([name, look, logs]) => ({ name, ...look, x: scene.density_n, y: logs.map((x) => (x === null ? null : 10 ** x)) })),
      { areas: classes, uprights: scene.band }
    );
  }

  function drawError(label) {
    const lines = task.entries.filter((name) => task.spectrum[name]).map((name) => ({
      name, ...style[name], x: task.thirds, y: task.spectrum[name][label] ?? task.spectrum[name][""],
    }));
    const bound = task.conditions[label].bound;
    if (bound) lines.unshift({ name: "bound", colour: "currentColor", dash: 2, x: task.thirds, y: bound });
    error.set(lines, { uprights: task.conditions[label].band });
  }

  function drawRuns() {
    if (!runs) return;
    runs.set(
      task.entries.filter((name) => task.performance[name]).map((name) => {
        const { share, low, high } = task.performance[name];
        return { name, ...style[name], x: task.thresholds, y: share, band: { low, high } };
      })
    );
  }

  function draw() {
    const label = form.elements.condition.value;
    const scene = task.conditions[label];
    document.getElementById("caption").textContent = scene.caption;
    drawRoad(scene, Number(form.elements.side.value));
    drawDensity(scene);
    drawError(label);
  }

  form.addEventListener("input", draw);
  form.addEventListener("submit", (event) => event.preventDefault());
  draw();
  drawRuns();
}

startTask();
