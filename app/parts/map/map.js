// The buffer as a map, beside the histograms of its rows (app/parts/map/__init__.py). One selection
// filters all of them here; the server hears of it when the hand stops.

const REST_MS = 250; // without a move: the hand has stopped
const CORNERS = 60; // of an outline, at most
const CLICK_PX = 4; // a pointer that moved less has clicked
const NEAR_PX = 14; // from a click to the row that it means
const FEW = 30; // rows of the effective sample below which no dimension is said to have the weight
const HISTS = 14; // histograms that are shown before the reader asks for all

const PRESETS = [
  ["Heaviest 1 %", () => ({ [RANK]: [99, null] })],
  ["Weight zero", () => ({ [WEIGHT]: [null, 0] })],
  ["Newest fifth", () => ({ [AGE]: [80, null] })],
  ["Everything", () => ({})],
];

const percent = (share) => {
  const value = 100 * share;
  if (!Number.isFinite(value)) return "–";
  return `${value >= 10 || value === 0 ? value.toFixed(0) : value >= 0.1 ? value.toFixed(1) : value.toPrecision(1)} %`;
};
const short = (value) => {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1000) return Math.round(value).toLocaleString("en-US");
  return String(Number(value.toPrecision(size >= 100 ? 3 : 2)));
};
const unitOf = (name) => (name === AGE || name === RANK ? " %" : "");
const element = (tag, name = "", words = "") => Object.assign(document.createElement(tag), { className: name, textContent: words });

const own = (name) => ({ name, low: 0, high: name === WEIGHT ? 1 : 100 });
const columnsOf = (root) => [own(WEIGHT), own(AGE), ...root.given.columns];
const columnNamed = (root, name) => (name === RANK ? own(RANK) : columnsOf(root).find((one) => one.name === name));

// --- What is chosen.

const worded = (selection) => [
  Object.entries(selection.intervals).map(([name, [low, high]]) => `${name} ${low ?? ""}..${high ?? ""}`),
  selection.outline ? [`${selection.outline.plane} ${selection.outline.corners.map((corner) => corner.join(",")).join(";")}`] : [],
];

function unworded([where, outline]) {
  const end = (words) => (words === "" ? null : Number(words));
  const intervals = {};
  for (const words of where) {
    const at = words.lastIndexOf(" ");
    intervals[words.slice(0, at)] = words.slice(at + 1).split("..").map(end);
  }
  if (!outline.length) return { intervals, outline: null };
  const at = outline[0].lastIndexOf(" ");
  const corners = outline[0].slice(at + 1).split(";").map((pair) => pair.split(",").map(Number));
  return { intervals, outline: { plane: outline[0].slice(0, at), corners } };
}

// Marks the rows that each filter leaves out. What is not here yet is filtered when it has come.
function filterAll(root) {
  const { rows, selection: { intervals, outline } } = root;
  const plane = outline && root.given.planes.find(({ key }) => key === outline.plane);
  const filters = Object.entries(intervals).map(([name, interval]) => [name, withinInterval(rows, columnNamed(root, name), interval)]);
  if (plane) filters.push(["outline", withinOutline(rows, plane, outline.corners)]);
  rows.failed.fill(0);
  rows.bits.clear();
  for (const [name, passes] of filters) {
    if (!passes) continue;
    const bit = 1 << rows.bits.size;
    rows.bits.set(name, bit);
    for (let i = 0; i < rows.count; i++) if (!passes(i)) rows.failed[i] |= bit;
  }
}

function choose(root, selection, { rest = 0 } = {}) {
  root.selection = selection;
  // At once: the browser gives a moving pointer once a frame.
  if (root.rows) drawNow(root);
  clearTimeout(root.rest);
  root.rest = setTimeout(() => {
    const words = JSON.stringify(worded(selection));
    if (words === root.told) return;
    root.told = words;
    root.tell("chosen", { where: worded(selection)[0], outline: worded(selection)[1] });
  }, rest);
}

function brushed(root, name, interval) {
  const intervals = { ...root.selection.intervals };
  if (interval) intervals[name] = interval;
  else delete intervals[name];
  if (name === WEIGHT) delete intervals[RANK];
  return { ...root.selection, intervals };
}

// --- What it is coloured by.

const diverging = (value, octaves) => Math.round(Math.min(Math.max(value / (2 * octaves) + 0.5, 0), 1) * (SHADES - 1));

function byWeight({ rows, tables }) {
  const mean = rows.total / rows.count || 1;
  return {
    by: (i) => rows.weight[i], table: tables.diverging,
    shade: (weight) => diverging(Math.log2(Math.max(weight / mean, 1e-9)), 4),
    title: "share of the weight : share of the rows", ticks: ["× 1/16", "equal", "× 16"],
    words: (weight) => `× ${short(weight / mean)} its share of the weight`,
  };
}

function colouring(root) {
  const { rows, given } = root;
  if (root.colour === "against" && given.against && root.against) {
    const { first, count, weight, total } = root.against;
    const [mean, other] = [rows.total / rows.count || 1, total / count || 1];
    const ratio = (i) => {
      const at = rows.first + i - first;
      if (at < 0 || at >= count) return NaN;
      return Math.log2(Math.max(rows.weight[i] / mean, 1 / 64) / Math.max(weight[at] / other, 1 / 64));
    };
    return {
      by: ratio, shade: (value) => diverging(value, 5), table: root.tables.diverging,
      title: `weight against that of ${given.against.label}`, ticks: ["× 1/32", "equal", "× 32"],
      words: (value) => `× ${short(2 ** value)} of the other's weight`,
    };
  }
  const column = root.colour === WEIGHT ? null : columnNamed(root, root.colour);
  const codes = column && rows.codes(column);
  if (codes) {
    return {
      by: (i) => (codes[i] === UNKNOWN ? NaN : codes[i]), table: root.tables.sequential,
      shade: (code) => Math.round((code / TOP) * (SHADES - 1)),
      title: `mean ${column.name}`, ticks: [0, TOP / 2, TOP].map((code) => short(valueOf(column, code)) + unitOf(column.name)),
      words: (code) => `${column.name} ${short(valueOf(column, code))}${unitOf(column.name)}`,
    };
  }
  return byWeight(root);
}

// --- Drawing.

function draw(root) {
  if (root.frame) return;
  root.frame = requestAnimationFrame(() => {
    root.frame = 0;
    if (root.isConnected && root.rows) drawNow(root);
  });
}

function drawNow(root) {
  if (!root.measured) measure(root);
  root.measured = true;
  filterAll(root);
  root.rows.passing = passingOf(root.rows);
  root.counts = new Map(); // histograms of this drawing
  drawMap(root);
  drawHistograms(root);
  say(root);
  root.dataset.drawn = JSON.stringify([root.rows.source.label, root.given.planes[0]?.key, root.rows.bits.size]);
  root.drawnAt = performance.now();
}

function drawMap(root) {
  const { rows, given } = root;
  const canvas = root.querySelector(".map-cells");
  const { context, width, height } = paper(canvas);
  const plane = given.planes[0];
  const [X, Y] = plane?.axes.map(rows.codes) ?? [];
  if (!X || !Y || !width) return;
  if (root.viewOf !== plane.key) [root.view, root.viewOf] = [wholeView(...plane.axes.map(({ url }) => here(url))), plane.key];
  const { view } = root;
  const look = colouring(root);
  const cells = cellsOf(rows, X, Y, view, width, height, look.by);
  root.cells = cells;
  const place = (x, y) => [((x - view.x[0]) / (view.x[1] - view.x[0])) * width, ((view.y[1] - y) / (view.y[1] - view.y[0])) * height];
  root.place = place;
  if (cells.inView < SINGLE) drawRows(context, rows, X, Y, place, look.by, look.shade, look.table, given.mode);
  else drawCells(context, cells, width, height, look.shade, look.table, given.mode, rows.bits.size > 0);
  drawOver(root, X, Y);
  legend(root, look, cells);
}

// The outline, the path of an episode, and a row with its nearest.
function drawOver(root, X, Y) {
  const { context } = paper(root.querySelector(".map-over"));
  const { rows, given, place, selection } = root;
  const ink = given.mode === "dark" ? "#e8ecf4" : "#1c2330";
  const plane = given.planes[0];
  const code = ([x, y]) => [x, y].map((value, i) => ((value - plane.axes[i].low) / (plane.axes[i].high - plane.axes[i].low || 1)) * TOP);
  const line = (points, close) => {
    context.beginPath();
    points.forEach(([x, y]) => context.lineTo(x, y));
    if (close) context.closePath();
    context.stroke();
  };
  [context.strokeStyle, context.lineWidth] = [ink, 1.5];
  if (root.drawing) line(root.drawing, true);
  else if (selection.outline?.plane === plane.key) line(selection.outline.corners.map((corner) => place(...code(corner))), true);
  const at = (row) => place(X[row - rows.first], Y[row - rows.first]);
  const within = (row) => row >= rows.first && row < rows.first + rows.count;
  const path = given.path && [Math.max(given.path[0], rows.first), Math.min(given.path[1], rows.first + rows.count - 1)];
  const strip = root.querySelector(".map-strip");
  const hidden = !(path && within(given.row));
  if (strip.hidden !== hidden) [strip.hidden, root.measured] = [hidden, false];
  if (hidden) return;
  if (!root.measured) measure(root);
  const points = [];
  for (let row = path[0]; row <= path[1]; row++) points.push(at(row));
  [context.globalAlpha, context.lineWidth] = [0.75, 1.3];
  line(points, false);
  context.globalAlpha = 1;
  const ring = ([x, y], r, fill) => {
    context.beginPath();
    context.arc(x, y, r, 0, 7);
    if (fill) [context.fillStyle = fill, context.fill()];
    context.stroke();
  };
  const back = given.mode === "dark" ? "#12151c" : "#ffffff";
  ring(points[0], 3.5, back);
  given.near.filter(within).forEach((row) => ring(at(row), 5.5, null));
  const marked = root.marked ?? given.row;
  context.lineWidth = 2.5;
  if (within(marked)) ring(at(marked), 7, back);
  const { shade, table } = byWeight(root);
  drawStrip(strip.querySelector("canvas"), rows, path, marked, root.colours, (w) => table[shade(w)]);
  strip.querySelector("p").textContent =
    `Row ${given.row.toLocaleString("en-US")}: its episode is the line that starts at the small ring; its ${given.near.length} nearest rows are rings. Below: weights along the episode's ${(given.path[1] - given.path[0] + 1).toLocaleString("en-US")} steps.`;
}

function legend(root, look, cells) {
  const box = root.querySelector(".map-legend");
  const bar = look.table.filter((_, i) => i % 15 === 0).map((colour) => `rgb(${colour})`).join(",");
  box.querySelector("i").style.background = `linear-gradient(to right, ${bar})`;
  box.querySelector("b").textContent = look.title;
  const ticks = box.querySelectorAll("span");
  look.ticks.forEach((words, i) => (ticks[i].textContent = words));
  const rows = cells.inView.toLocaleString("en-US");
  box.querySelector("em").textContent =
    cells.inView < SINGLE ? `each point is a row; ${rows} in view` : `opacity: number of rows; ${rows} in view`;
  const axes = root.given.planes[0].axes;
  root.querySelector(".map-x").textContent = `${axes[0].name} →`;
  root.querySelector(".map-y").textContent = `${axes[1].name} →`;
}

function countsOf(root, column) {
  if (!root.counts.has(column.name)) root.counts.set(column.name, histogram(root.rows, column));
  return root.counts.get(column.name);
}

function drawHistograms(root) {
  for (const figure of root.querySelectorAll(".map-hist:not([hidden])")) {
    const column = columnNamed(root, figure.dataset.name);
    const counts = countsOf(root, column);
    if (!counts) continue;
    const brush = root.selection.intervals[column.name] ?? null;
    drawBars(figure.querySelector("canvas"), column, counts, brush, root.colours);
    const unit = unitOf(column.name);
    const [low, high] = column.name === WEIGHT ? ["0", "× 64"] : [short(column.low) + unit, short(column.high) + unit];
    const [first, middle, last] = figure.querySelectorAll("footer span");
    [first.textContent, last.textContent] = [low, high];
    middle.textContent = brush ? between(brush, unit) : "";
    figure.querySelector("output").textContent = apart(counts);
    figure.querySelector("canvas").setAttribute("aria-valuetext", brush ? between(brush, unit) : "all");
  }
}

const between = ([low, high], unit = "") =>
  low === null ? `under ${short(high)}${unit}` : high === null ? `above ${short(low)}${unit}` : `${short(low)} to ${short(high)}${unit}`;

// How far the mean of the chosen rows (or of the weight) is from that of all rows, in deviations.
function gap({ whole, chosen }) {
  const all = moments(whole.count);
  const part = moments(chosen ?? whole.weight);
  return all.deviation > 1e-9 && part.n > 0 ? (part.mean - all.mean) / all.deviation : 0;
}
function apart(counts) {
  const sd = gap(counts);
  return Math.abs(sd) < 0.05 ? "" : `${sd > 0 ? "+" : "−"}${Math.abs(sd).toFixed(1)} sd`;
}

// The quantities in which the chosen rows (or the weight) differ most from all rows.
function telling(root, most) {
  const found = columnsOf(root)
    .filter(({ name }) => ![WEIGHT, "policy version"].includes(name) && !(name in root.selection.intervals))
    .map((column) => [column.name, countsOf(root, column)])
    .filter(([, counts]) => counts)
    .map(([name, counts]) => [name, gap(counts)])
    .filter(([, sd]) => Math.abs(sd) >= 0.25);
  found.sort((a, b) => Math.abs(b[1]) - Math.abs(a[1]));
  return found.slice(0, most).map(([name, sd]) => {
    const what = name === AGE ? `rows stored ${sd > 0 ? "later" : "earlier"}` : `${sd > 0 ? "high" : "low"} ${name}`;
    return `${what} (${sd > 0 ? "+" : "−"}${Math.abs(sd).toFixed(1)} sd)`;
  });
}

function say(root) {
  const { rows, selection } = root;
  const { n, sum, squares, zero, age } = summary(rows);
  const chosen = rows.bits.size > 0;
  const parts = Object.entries(selection.intervals).map(([name, interval]) => {
    if (name === RANK) return `the heaviest ${short(100 - interval[0])} %`;
    if (name === WEIGHT && interval[1] === 0) return "weight zero";
    return `${name} ${between(interval, unitOf(name))}`;
  });
  if (selection.outline) parts.push("inside the outline");
  const most = n ? telling(root, parts.length ? 2 : 3) : [];
  const heading = root.querySelector(".map-sentence");
  if (!rows.count) heading.textContent = "The buffer is empty.";
  else if (!chosen) {
    const sample = (sum * sum) / squares;
    heading.textContent = sample < FEW && 2 * sample < rows.count
      ? `Nearly all of the weight lies on ${sample < 1.5 ? "one row" : `about ${sample.toFixed(0)} rows`}.`
      : most.length
      ? `The weight goes to ${most.join(", ")}.`
      : "No part of the buffer stands out: the weight is spread about as the rows are.";
  } else {
    const what = n ? `${percent(n / rows.count)} of the rows have ${percent(sum / rows.total)} of the weight` : "No row is chosen";
    heading.textContent = `${what}: ${parts.join(", ")}${most.length ? `; mostly ${most.join(", ")}` : ""}.`;
  }
  const numbers = {
    rows: `${n.toLocaleString("en-US")} of ${rows.count.toLocaleString("en-US")}`,
    "mean weight": short(sum / n / (rows.total / rows.count || 1)),
    "effective sample": percent((sum * sum) / squares / n),
    "weight zero": percent(zero / n),
    "mean age": n ? `${age.toFixed(0)} %` : "–",
  };
  root.querySelector(".map-numbers").replaceChildren(
    ...Object.entries(numbers).map(([name, value]) => {
      const box = element("div");
      box.append(element("dt", "", name), element("dd", "", value));
      return box;
    }),
  );
  root.dataset.rows = n;
  root.querySelectorAll(".map-presets button").forEach((button, i) => {
    const same = JSON.stringify(PRESETS[i][1]()) === JSON.stringify(selection.intervals) && !selection.outline;
    button.setAttribute("aria-pressed", same);
  });
}
