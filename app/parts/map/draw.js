// What the buffer's map draws on its canvases.

const CELL_ROWS = 5; // rows in a cell if they lay evenly
const SINGLE = 5000; // rows in view below which each is drawn by itself
const [FEWEST, MOST] = [36, 220]; // cells across
const SHADES = 256;

// A scale of colours with stops (place, #rrggbb) as a table of red, green and blue.
function shades(stops) {
  const rgb = (colour) => [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return Array.from({ length: SHADES }, (_, i) => {
    const at = i / (SHADES - 1);
    let k = 1;
    while (k < stops.length - 1 && stops[k][0] < at) k++;
    const [[from, a], [to, b]] = [stops[k - 1], stops[k]];
    const share = Math.min(Math.max((at - from) / (to - from || 1), 0), 1);
    const [one, two] = [rgb(a), rgb(b)];
    return one.map((part, c) => Math.round(part + share * (two[c] - part)));
  });
}

// Notes the size of every canvas at once: to ask for one after a change lays out the whole page.
function measure(root) {
  for (const canvas of root.querySelectorAll("canvas")) canvas.size = [canvas.clientWidth, canvas.clientHeight];
}

// Sizes a canvas to its place on the page; its context in CSS pixels.
function paper(canvas) {
  const dense = window.devicePixelRatio || 1;
  const [width, height] = canvas.size;
  if (canvas.width !== Math.round(width * dense) || canvas.height !== Math.round(height * dense)) {
    [canvas.width, canvas.height] = [Math.round(width * dense), Math.round(height * dense)];
  }
  const context = canvas.getContext("2d");
  context.setTransform(dense, 0, 0, dense, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

// The part of a plane that holds nearly all rows, in codes, with a margin.
function wholeView(X, Y) {
  const ends = (codes) => {
    const counts = new Uint32Array(1025);
    for (let i = 0; i < codes.length; i++) counts[codes[i] >> 6]++;
    const find = (from, by) => {
      let [left, at] = [codes.length * 0.001, from];
      while (left > 0 && at >= 0 && at <= 1024) [left, at] = [left - counts[at], at + by];
      return at * 64;
    };
    const [low, high] = [find(0, 1), find(1024, -1)];
    const margin = Math.max((high - low) * 0.08, 400);
    return [low - margin, high + margin];
  };
  return { x: ends(X), y: ends(Y) };
}

// Counts rows in cells of the view: all, the chosen ones, and the sum of what they are coloured by.
function cellsOf(rows, X, Y, view, width, height, by) {
  const all = allCells(rows, X, Y, view, width, height);
  const { across, down, at } = all;
  const cells = { ...all, n: new Uint32Array(across * down), sum: new Float64Array(across * down) };
  if (all.inView < SINGLE) return cells;
  const { passing } = rows;
  for (let k = 0; k < passing.length; k++) {
    const i = passing[k];
    const cell = at[i];
    if (cell < 0) continue;
    const value = by(i);
    if (value !== value) continue; // not known of this row
    cells.n[cell]++;
    cells.sum[cell] += value;
  }
  return cells;
}

// The cell of each row, -1 out of view. It lasts while neither the view nor the fit changes.
function allCells(rows, X, Y, view, width, height) {
  const [[x0, x1], [y0, y1]] = [view.x, view.y];
  const key = [X.buffer, view, width, height];
  if (rows.cells && rows.cells.key.every((part, i) => part === key[i])) return rows.cells;
  const { count } = rows;
  let inView = 0;
  for (let i = 0; i < count; i++) {
    if (X[i] >= x0 && X[i] <= x1 && Y[i] >= y0 && Y[i] <= y1) inView++;
  }
  const across = Math.round(Math.min(Math.max(Math.sqrt(inView / CELL_ROWS), FEWEST), MOST));
  const down = Math.max(Math.round((across * height) / width), 1);
  const all = new Uint32Array(across * down);
  const at = new Int32Array(count).fill(-1);
  const [sx, sy] = [across / (x1 - x0), down / (y1 - y0)];
  for (let i = 0; i < count; i++) {
    const x = ((X[i] - x0) * sx) | 0;
    const y = ((y1 - Y[i]) * sy) | 0;
    if (X[i] < x0 || Y[i] > y1 || x >= across || y >= down) continue;
    at[i] = y * across + x;
    all[at[i]]++;
  }
  rows.cells = { key, across, down, inView, all, at };
  return rows.cells;
}

const grey = (mode) => (mode === "dark" ? [126, 134, 150] : [150, 156, 168]);

function drawCells(context, cells, width, height, shadeOf, table, mode, filtered) {
  const { across, down, all, n, sum } = cells;
  const image = new ImageData(across, down);
  const counts = all.filter((count) => count > 0).sort();
  const full = counts[Math.floor(counts.length * 0.75)] || 1;
  const opacity = (count) => 0.35 + 0.65 * Math.sqrt(Math.min(count / full, 1));
  const pale = grey(mode);
  for (let cell = 0; cell < all.length; cell++) {
    if (!all[cell]) continue;
    const chosen = n[cell] > 0;
    const colour = chosen ? table[shadeOf(sum[cell] / n[cell])] : pale;
    const alpha = chosen ? opacity(filtered ? Math.max(n[cell], full / 4) : n[cell]) : 0.3 * opacity(all[cell]);
    image.data.set([...colour, 255 * alpha], 4 * cell);
  }
  const small = new OffscreenCanvas(across, down);
  small.getContext("2d").putImageData(image, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(small, 0, 0, width, height);
}

function drawRows(context, rows, X, Y, place, by, shadeOf, table, mode) {
  const { failed, count } = rows;
  const [width, height] = context.canvas.size;
  for (const chosen of [false, true]) {
    for (let i = 0; i < count; i++) {
      if ((failed[i] === 0) !== chosen) continue;
      const [x, y] = place(X[i], Y[i]);
      if (x < 0 || y < 0 || x > width || y > height) continue;
      const value = by(i);
      const colour = chosen && value === value ? table[shadeOf(value)] : grey(mode);
      context.fillStyle = `rgba(${colour}, ${chosen ? 0.9 : 0.25})`;
      context.beginPath();
      context.arc(x, y, chosen ? 2.6 : 2, 0, 7);
      context.fill();
    }
  }
}

// A histogram: grey are all rows, filled those that are chosen, each as shares of its own total; the
// line is where the weight lies.
function drawBars(canvas, column, { whole, chosen }, brush, colours) {
  const { context, width, height } = paper(canvas);
  const share = (counts) => {
    let total = 0;
    for (let b = 0; b < BINS; b++) total += counts[b];
    return Float64Array.from({ length: BINS }, (_, b) => counts[b] / (total || 1));
  };
  const shown = { all: share(whole.count), weight: share(whole.weight), chosen: chosen && share(chosen) };
  const peak = Math.max(...Object.values(shown).filter(Boolean).flatMap((part) => [...part]).sort((a, b) => b - a).slice(2, 3), 1e-9) * 1.05;
  const bar = width / BINS;
  const tall = (value) => Math.min(value / peak, 1) * (height - 2);
  const fill = (part, style) => {
    context.fillStyle = style;
    part.forEach((value, b) => value && context.fillRect(b * bar, height - Math.max(tall(value), 1), bar - 0.4, Math.max(tall(value), 1)));
  };
  fill(shown.all, colours.all);
  if (shown.chosen) fill(shown.chosen, colours.chosen);
  context.strokeStyle = colours.weight;
  context.lineWidth = 1.6;
  context.beginPath();
  shown.weight.forEach((value, b) => {
    const y = height - 1 - tall(value);
    context.lineTo(b * bar, y);
    context.lineTo((b + 1) * bar, y);
  });
  context.stroke();
  if (!brush) return;
  const [from, to] = [brush[0] === null ? 0 : shareOf(column, brush[0]), brush[1] === null ? 1 : shareOf(column, brush[1])];
  context.fillStyle = colours.brush;
  context.fillRect(from * width, 0, (to - from) * width, height);
  context.fillStyle = colours.edge;
  for (const at of [from, to]) context.fillRect(Math.min(Math.max(at * width - 1, 0), width - 2), 0, 2, height);
}

// The weights of one episode along its steps, on a log axis; the dashed line is the mean weight.
function drawStrip(canvas, rows, [from, to], row, colours, shade) {
  const { context, width, height } = paper(canvas);
  const n = to - from + 1;
  const x = (i) => ((i - from + 0.5) / n) * width;
  const y = (w) => height / 2 - (Math.min(Math.max(Math.log2(Math.max(w, 1e-9)), -5), 5) / 5) * (height / 2 - 4);
  context.strokeStyle = colours.all;
  context.setLineDash([4, 4]);
  context.beginPath();
  context.moveTo(0, y(1));
  context.lineTo(width, y(1));
  context.stroke();
  context.setLineDash([]);
  for (let i = from; i <= to; i++) {
    const w = rows.weight[i - rows.first];
    context.fillStyle = `rgb(${shade(w)})`;
    context.fillRect(x(i) - Math.max(width / n / 2, 1), Math.min(y(w), y(1)), Math.max(width / n - 0.5, 1.5), Math.abs(y(w) - y(1)) + 1.5);
  }
  context.fillStyle = colours.edge;
  context.fillRect(x(row) - 1, 0, 2, height);
}
