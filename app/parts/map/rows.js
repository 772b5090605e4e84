// The rows of the buffer's map: arrays of 16-bit codes, which rows are chosen, and what they hold.
// The server chooses rows by the same codes and arithmetic (app/data/columns.py, selection.py).

const TOP = 65534; // the highest code of a value
const UNKNOWN = 65535;
const OCTAVES = 16; // weights are coded from 2^-16 to 2^16 times their mean
const SHOWN_OCTAVES = 6; // of them in a histogram
const BINS = 64;
const [AGE, RANK, WEIGHT, DISTANCE] = ["age", "weight rank", "weight", "policy distance"];

// An array is fetched once, and kept while the page names it.
const fetched = (window.tomArrays ??= new Map());

function array(url) {
  if (!fetched.has(url)) {
    const coming = fetch(url).then(async (answer) => {
      if (!answer.ok) throw new Error(`${answer.status} for ${url}`);
      const codes = new Uint16Array(await answer.arrayBuffer());
      fetched.set(url, codes);
      return codes;
    });
    coming.catch(() => fetched.delete(url)); // the next drawing asks again
    fetched.set(url, coming);
  }
  return fetched.get(url);
}

const here = (url) => (fetched.get(url) instanceof Uint16Array ? fetched.get(url) : null);

function forgetAllBut(urls) {
  for (const url of fetched.keys()) if (!urls.has(url)) fetched.delete(url);
}

const OCTAVE_OF = (code) => ((code - 1) / (TOP - 1)) * 2 * OCTAVES - OCTAVES;
const WEIGHT_OF = Float64Array.from({ length: 65536 }, (_, code) => (code ? 2 ** OCTAVE_OF(code) : 0));

// The value of a code of a quantity.
function valueOf(column, code) {
  if (column.name === WEIGHT) return WEIGHT_OF[code];
  return column.low + (code / TOP) * (column.high - column.low);
}

// By code, the bin of a histogram; 255 is none.
const EVEN_BIN = Uint8Array.from({ length: 65536 }, (_, code) => (code === UNKNOWN ? 255 : code >> 10));
const WEIGHT_BIN = Uint8Array.from({ length: 65536 }, (_, code) => {
  if (!code) return 0;
  const at = (OCTAVE_OF(code) + SHOWN_OCTAVES) / (2 * SHOWN_OCTAVES);
  return Math.min(Math.max(Math.floor(2 + at * (BINS - 2)), 2), BINS - 1);
});
const binsOf = (column) => (column.name === WEIGHT ? WEIGHT_BIN : EVEN_BIN);

// The place of a value on a histogram's axis, from 0 to 1, and back.
function shareOf(column, value) {
  if (column.name !== WEIGHT) return (value - column.low) / (column.high - column.low || 1);
  if (value <= 0) return 0.5 / BINS;
  const at = (Math.log2(value) + SHOWN_OCTAVES) / (2 * SHOWN_OCTAVES);
  return (2 + at * (BINS - 2)) / BINS;
}
function atShare(column, share) {
  if (column.name !== WEIGHT) return column.low + share * (column.high - column.low);
  const at = (share * BINS - 2) / (BINS - 2);
  return at < 0 ? 0 : 2 ** ((at * 2 - 1) * SHOWN_OCTAVES);
}

// The first and the last code of an interval; an open end is null.
function bounds(column, [low, high]) {
  if (column.name === WEIGHT) {
    const code = (value) => 1 + ((Math.log2(value) + OCTAVES) / (2 * OCTAVES)) * (TOP - 1);
    const first = low === null || low <= 0 ? 0 : Math.ceil(code(low) - 1e-6);
    const last = high === null ? TOP : high <= 0 ? 0 : Math.floor(code(high) + 1e-6);
    return [first, last];
  }
  if (column.high <= column.low) {
    const within = (low === null || low <= column.low) && (high === null || column.low <= high);
    return within ? [0, UNKNOWN] : [1, 0];
  }
  const span = column.high - column.low;
  const first = low === null ? 0 : Math.ceil(((low - column.low) / span) * TOP - 1e-6);
  const last = high === null ? TOP : Math.floor(((high - column.low) / span) * TOP + 1e-6);
  return [Math.max(first, 0), Math.min(last, TOP)];
}

// --- The rows of one fit.

// Ages and ranks are codes of the fit, made here, and distances to its policy are its own; all else
// is the record's, from row `first` on.
function rowsOf(given, source, weights) {
  const count = source.count;
  const age = new Uint16Array(count);
  for (let i = 0; i < count; i++) age[i] = Math.floor((i * TOP) / Math.max(count - 1, 1));
  const below = new Float64Array(65536);
  for (let i = 0; i < count; i++) below[weights[i]]++;
  for (let c = 1; c < 65536; c++) below[c] += below[c - 1];
  const rank = new Uint16Array(count);
  const rankOf = Uint16Array.from(below, (n) => Math.ceil((Math.max(n - 1, 0) * TOP) / Math.max(count, 1)));
  const weight = new Float32Array(count);
  let total = 0;
  let squares = 0;
  for (let i = 0; i < count; i++) {
    rank[i] = rankOf[weights[i]];
    const w = WEIGHT_OF[weights[i]];
    weight[i] = w;
    total += w;
    squares += w * w;
  }
  const own = { [AGE]: age, [RANK]: rank, [WEIGHT]: weights };
  // `failed` has the bit of each filter that leaves a row out.
  const rows = { source, first: source.first, count, weight, total, squares, own, failed: new Uint32Array(count), bits: new Map(), store: new Uint32Array(count + 1) };
  // The codes of a quantity of the record, or an axis of a plane, by its address; else of the fit.
  rows.codes = ({ name, url }) => {
    if (url) return here(url)?.subarray(source.first, source.first + count);
    return name === DISTANCE ? source.distance && here(source.distance) : own[name];
  };
  return rows;
}

// Whether a row's quantity lies in an interval; null if its codes are not here yet.
function withinInterval(rows, column, interval) {
  const codes = column && rows.codes(column);
  if (!codes) return null;
  const [first, last] = bounds(column, interval);
  return (i) => codes[i] >= first && codes[i] <= last;
}

// Whether a row lies inside a closed outline, by the even-odd rule: rows are counted, not cells.
function withinOutline(rows, plane, corners) {
  const [X, Y] = plane.axes.map(rows.codes);
  if (!X || !Y) return null;
  const [ax, ay] = plane.axes;
  const [xs, ys] = [0, 1].map((axis) => corners.map((corner) => corner[axis]));
  const [left, right, bottom, top] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const n = corners.length;
  return (i) => {
    const x = ax.low + (X[i] / TOP) * (ax.high - ax.low);
    const y = ay.low + (Y[i] / TOP) * (ay.high - ay.low);
    if (x < left || x > right || y < bottom || y > top) return false;
    let within = false;
    for (let k = 0; k < n; k++) {
      const [x0, y0, x1, y1] = [xs[k], ys[k], xs[(k + 1) % n], ys[(k + 1) % n]];
      if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) within = !within;
    }
    return within;
  };
}

// How many rows, and how much weight, lie in each bin: all rows, and those that pass every other
// filter. A quantity's own brush does not change its own histogram.
function histogram(rows, column) {
  const codes = rows.codes(column);
  if (!codes) return null;
  const bins = binsOf(column);
  const { failed, weight, count } = rows;
  rows.whole ??= new Map();
  let whole = rows.whole.get(column.name);
  if (!whole) {
    whole = { count: new Float64Array(256), weight: new Float64Array(256) };
    for (let i = 0; i < count; i++) {
      const bin = bins[codes[i]];
      whole.count[bin]++;
      whole.weight[bin] += weight[i];
    }
    rows.whole.set(column.name, whole);
  }
  if (!rows.bits.size) return { whole, chosen: null };
  const chosen = new Uint32Array(256);
  const bit = rows.bits.get(column.name);
  if (bit) {
    for (let i = 0; i < count; i++) if ((failed[i] & ~bit) === 0) chosen[bins[codes[i]]]++;
  } else {
    const { passing } = rows;
    for (let k = 0; k < passing.length; k++) chosen[bins[codes[passing[k]]]]++;
  }
  return { whole, chosen };
}

// The rows that no filter leaves out.
function passingOf({ failed, count, store }) {
  let n = 0;
  for (let i = 0; i < count; i++) {
    store[n] = i;
    if (failed[i] === 0) n++;
  }
  return store.subarray(0, n);
}

// The numbers of the chosen rows.
function summary(rows) {
  const { passing, weight, count } = rows;
  const n = passing.length;
  let [sum, squares, zero, age] = [0, 0, 0, 0];
  for (let k = 0; k < n; k++) {
    const i = passing[k];
    const w = weight[i];
    sum += w;
    squares += w * w;
    if (!w) zero++;
    age += i;
  }
  return { n, sum, squares, zero, age: (100 * (age / n + 0.5)) / count };
}

// The mean of a quantity in a histogram's bins, and its deviation, both in bins.
function moments(counts) {
  let [n, sum, squares] = [0, 0, 0];
  for (let b = 0; b < BINS; b++) {
    n += counts[b];
    sum += counts[b] * b;
    squares += counts[b] * b * b;
  }
  const mean = sum / n;
  return { n, mean, deviation: Math.sqrt(Math.max(squares / n - mean * mean, 0)) };
}
