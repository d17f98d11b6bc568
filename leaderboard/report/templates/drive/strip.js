// Opens the profile of a segment below its row: on a click on the row, or on the segment in the track.
"use strict";
const SIZE = { width: 900, height: 170, left: 46, right: 8, top: 18, bottom: 26 };

function decoded(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Int16Array(bytes.buffer);
}

function heightsOf(anchor) {
  const data = JSON.parse(document.querySelector(`.heights[data-anchor="${anchor}"]`).textContent);
  for (const path of data.paths) path.values = decoded(path.heights);
  return data;
}

// Round numbers between low and high, about `count` of them.
function ticks(low, high, count) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
  const found = [];
  for (let x = Math.ceil(low / step) * step; x <= high + 1e-9; x += step) found.push(x);
  return found;
}

function drawing(data, begin, end) {
  const first = Math.max(0, Math.ceil((begin - data.begin) / data.step));
  const parts = data.paths.map((path) => {
    const last = Math.min(path.values.length, Math.floor((end - data.begin) / data.step) + 1);
    return Array.from(path.values.subarray(first, last), (value) => data.unit * value);
  });
  const limit = 1.1 * Math.max(1, ...parts.flat().map(Math.abs));
  const x = (s) => SIZE.left + ((SIZE.width - SIZE.left - SIZE.right) * (s - begin)) / (end - begin);
  const y = (z) => SIZE.top + ((SIZE.height - SIZE.top - SIZE.bottom) * (limit - z)) / (2 * limit);
  const grid = [
    ...ticks(begin, end, 8).map((s) =>
      `<path d="M${x(s)} ${SIZE.top}V${SIZE.height - SIZE.bottom}"/>` +
      `<text x="${x(s)}" y="${SIZE.height - 8}" text-anchor="middle">${+s.toFixed(2)} m</text>`),
    ...ticks(-limit, limit, 4).map((z) =>
      `<path d="M${SIZE.left} ${y(z)}H${SIZE.width - SIZE.right}"/>` +
      `<text x="${SIZE.left - 4}" y="${y(z) + 4}" text-anchor="end">${+z.toFixed(1)}</text>`),
  ];
  const lines = parts.map((part, k) => {
    const points = part.map((z, i) => `${x(data.begin + (first + i) * data.step).toFixed(1)},${y(z).toFixed(1)}`);
    return `<polyline points="${points.join(" ")}" fill="none" stroke="${data.paths[k].colour}" stroke-width="1.3"/>`;
  });
  const names = data.paths.map((path, k) =>
    `<text x="${SIZE.width - SIZE.right - 130 * k}" y="12" text-anchor="end" fill="${path.colour}">${path.name}</text>`);
  return `<svg viewBox="0 0 ${SIZE.width} ${SIZE.height}" role="img" font-size="11" fill="#444">` +
    `<g stroke="#e4e4e4" stroke-width="1">${grid.join("").replaceAll("<text", '<text stroke="none"')}</g>` +
    `<text x="${SIZE.left}" y="12">height [mm], without waves longer than 20 m</text>` +
    `${names.join("")}${lines.join("")}</svg>`;
}

function open(row) {
  const next = row.nextElementSibling;
  if (next?.classList.contains("opened")) return next;
  const begin = Number(row.dataset.begin), end = Number(row.dataset.end);
  const anchor = row.id.replace(/-\d+$/, "");
  const opened = document.createElement("tr");
  opened.className = "opened";
  opened.innerHTML = `<td colspan="${row.cells.length}">${drawing(heightsOf(anchor), begin, end)}</td>`;
  row.after(opened);
  return opened;
}

function openTarget() {
  const row = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (row?.classList.contains("of-segment")) open(row);
}

for (const row of document.querySelectorAll("tr.of-segment"))
  row.addEventListener("click", () => {
    const next = row.nextElementSibling;
    if (next?.classList.contains("opened")) next.remove();
    else open(row);
  });
window.addEventListener("hashchange", openTarget);
openTarget();
document.documentElement.dataset.ready = "yes";
