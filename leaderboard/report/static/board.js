// Filters, groups and sorting of the tables. The numbers are part of the page; nothing is fetched.
"use strict";

const DASH = "–";

class BoardTable {
  constructor(table) {
    this.table = table;
    this.data = JSON.parse(document.getElementById(table.dataset.source).textContent);
    this.rows = [...table.tBodies[0].rows];
    this.rowData = new Map(this.data.rows.map((row) => [row.name, row]));
    this.sorting = { key: null, down: false };
    table.querySelectorAll("button.sort").forEach((button) => {
      button.addEventListener("click", () => this.sortBy(button.dataset.key));
    });
  }

  get groups() {
    return this.data.groups;
  }

  /** Return number and text of a cell in the selected group and division. */
  cell(line, key) {
    const numbers = line.groups[this.group] ?? {};
    const name = key === "rank" && this.division === "causal" ? "rank_causal" : key;
    return numbers[name] ?? [null, line.sparse ? "" : this.data.columns[key]?.blank ?? ""];
  }

  show(state) {
    const known = Object.values(this.groups).flat();
    this.group = known.includes(state.group) ? state.group : "";
    this.division = state.division || "";
    for (const row of this.rows) {
      const line = this.rowData.get(row.dataset.name);
      const search = (state.find || "").toLowerCase();
      const hidden =
        (this.division === "causal" && line.state === "scored" && !line.causal) ||
        (state.find && !line.name.toLowerCase().includes(search)) ||
        (state.baselines === "off" && line.state === "baseline");
      row.hidden = Boolean(hidden);
      if (!line.message) this.fill(row, line);
    }
    this.table.classList.toggle("all", state.columns === "all");
    this.order();
  }

  fill(row, line) {
    for (const cell of row.querySelectorAll("td[data-key]")) {
      const column = this.data.columns[cell.dataset.key];
      if (cell.dataset.key === "interval") this.drawInterval(cell, line);
      else if (column) [, cell.textContent] = this.cell(line, cell.dataset.key);
      else if (this.group) cell.textContent = ""; // known for all runs together only
      else cell.textContent = line.cells[cell.dataset.key] ?? "";
    }
  }

  drawInterval(cell, line) {
    const [[low, from], [high, to]] = ["low", "high"].map((key) => this.cell(line, key));
    cell.replaceChildren();
    if (low === null || high === null) return;
    const at = [low, high].map((x) => (100 * Math.min(x, this.data.scale)) / this.data.scale);
    const bar = document.createElement("span");
    bar.className = "bar";
    bar.style.setProperty("--low", `${at[0].toFixed(2)}%`);
    bar.style.setProperty("--width", `${(at[1] - at[0]).toFixed(2)}%`);
    if (this.data.flat) bar.style.setProperty("--one", `${(100 * this.data.flat) / this.data.scale}%`);
    const text = document.createElement("span");
    text.className = "ends";
    text.textContent = `${from}${DASH}${to}`;
    cell.append(bar, text);
  }

  sortBy(key) {
    const again = this.sorting.key === key;
    const best = this.data.columns[key]?.better === "high";
    this.sorting = { key, down: again ? !this.sorting.down : best };
    this.order();
  }

  order() {
    const { key, down } = this.sorting;
    const by = key ?? this.data.ranks_by;
    const groupOf = { claim: 0, scored: 1, baseline: key ? 1 : 2, failed: 3, stale: 4 };
    const place = (row) => {
      const line = this.rowData.get(row.dataset.name);
      const value = key === "name" ? line.name : line.message ? null : this.cell(line, by)[0];
      // by default in the order of the ranks, where there are any, and who can have none last
      const ranked = !key && line.state === "scored";
      const rank = ranked ? this.cell(line, this.data.rank)[0] ?? Infinity : 0;
      const outside = ranked && this.data.rank === "rank_causal" && !line.causal;
      return { group: groupOf[line.state] + (outside ? 0.5 : 0), rank, value };
    };
    const sign = down ? -1 : 1;
    this.rows.sort((a, b) => {
      const [p, q] = [place(a), place(b)];
      if (p.group !== q.group) return p.group - q.group;
      if (p.rank !== q.rank) return p.rank < q.rank ? -1 : 1;
      if (p.value === null || q.value === null) return (p.value === null) - (q.value === null);
      return sign * (p.value < q.value ? -1 : p.value > q.value ? 1 : 0);
    });
    this.table.tBodies[0].append(...this.rows);
    this.table.querySelectorAll("th[data-key]").forEach((head) => {
      const mine = head.dataset.key === (key ?? "");
      head.setAttribute("aria-sort", mine ? (down ? "descending" : "ascending") : "none");
    });
  }
}

/** Filter settings stand in the fragment of the address, so that a view can be shared as a link. */
function startBoards() {
  const tables = [...document.querySelectorAll("table[data-source]")].map((t) => new BoardTable(t));
  const form = document.getElementById("filters");
  fillGroups(form.elements.group, tables);
  const stored = new URLSearchParams(location.hash.slice(1));
  for (const field of [...form.elements].filter(({ name }) => stored.has(name))) {
    if (field.type === "checkbox") field.checked = stored.get(field.name) === field.value;
    else field.value = stored.get(field.name);
  }
  const show = () => showTables(Object.fromEntries(new FormData(form)), tables);
  const store = () => {
    const chosen = [...new FormData(form)].filter(([, value]) => value);
    const hash = new URLSearchParams(chosen).toString();
    history.replaceState(null, "", hash ? "#" + hash : location.pathname);
    show();
  };
  form.addEventListener("input", store);
  form.addEventListener("submit", (event) => event.preventDefault());
  document.getElementById("clear")?.addEventListener("click", () => {
    form.reset();
    store();
  });
  show();
  document.documentElement.dataset.ready = "yes";
}

function showTables(state, tables) {
  document.querySelectorAll("article[data-groups]").forEach((article) => {
    const groups = JSON.parse(article.dataset.groups);
    article.hidden = Boolean(state.group && !groups.includes(state.group));
  });
  document.querySelectorAll("section[data-board]").forEach((section) => {
    const empty = !section.querySelector("article:not([hidden])");
    section.hidden = empty || Boolean(state.board && section.dataset.board !== state.board);
  });
  tables.forEach((table) => table.show(state));
  const count = document.getElementById("count");
  if (!count) return;
  const rows = tables.flatMap((table) => table.rows);
  const visible = rows.filter((row) => !row.closest("[hidden]")).length;
  count.textContent = `${visible} of ${rows.length} rows`;
  document.getElementById("nothing").hidden = visible > 0;
}

function fillGroups(select, tables) {
  const kinds = {};
  for (const table of tables) {
    for (const [kind, names] of Object.entries(table.groups)) {
      kinds[kind] = [...new Set([...(kinds[kind] ?? []), ...names])];
    }
  }
  for (const [kind, names] of Object.entries(kinds)) {
    const group = document.createElement("optgroup");
    group.label = `by ${kind}`;
    group.append(...names.map((name) => new Option(name, name)));
    select.append(group);
  }
}

startBoards();
