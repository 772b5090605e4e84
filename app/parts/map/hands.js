// The map's pointer, keys and panels, and what the server gives it (app/parts/map/__init__.py).

function zoomAt(root, [px, py], factor) {
  const { clientWidth, clientHeight } = root.querySelector(".map-cells");
  const scaled = ([low, high], share) => {
    const at = low + share * (high - low);
    const size = Math.min(Math.max((high - low) * factor, 40), 4 * TOP);
    return [at - share * size, at + (1 - share) * size];
  };
  root.view = { x: scaled(root.view.x, px / clientWidth), y: scaled(root.view.y, 1 - py / clientHeight) };
  draw(root);
}

function pan(root, dx, dy) {
  const { clientWidth, clientHeight } = root.querySelector(".map-cells");
  const moved = ([low, high], by) => [low - by * (high - low), high - by * (high - low)];
  root.view = { x: moved(root.view.x, dx / clientWidth), y: moved(root.view.y, -dy / clientHeight) };
  draw(root);
}

// A point of the canvas in codes of the plane, and in its own units.
function codeAt(root, [px, py]) {
  const { clientWidth, clientHeight } = root.querySelector(".map-cells");
  const { x, y } = root.view;
  return [x[0] + (px / clientWidth) * (x[1] - x[0]), y[1] - (py / clientHeight) * (y[1] - y[0])];
}
function valueAt(root, point) {
  return codeAt(root, point).map((code, i) => {
    const { low, high } = root.given.planes[0].axes[i];
    return Number((low + (code / TOP) * (high - low)).toPrecision(5));
  });
}

// The row nearest to a point of the canvas, if one is near; a chosen one before others.
function rowAt(root, [px, py]) {
  const { rows, given, place } = root;
  const [X, Y] = given.planes[0]?.axes.map(rows.codes) ?? [];
  if (!X || !Y || !place) return null;
  const [cx, cy] = codeAt(root, [px, py]);
  const { clientWidth, clientHeight } = root.querySelector(".map-cells");
  const [wide, high] = [((root.view.x[1] - root.view.x[0]) * NEAR_PX) / clientWidth, ((root.view.y[1] - root.view.y[0]) * NEAR_PX) / clientHeight];
  let [best, row] = [1, null];
  for (let i = 0; i < rows.count; i++) {
    const dx = (X[i] - cx) / wide;
    if (dx > 1 || dx < -1) continue;
    const dy = (Y[i] - cy) / high;
    const away = dx * dx + dy * dy + (rows.failed[i] ? 0.5 : 0);
    if (away < best) [best, row] = [away, rows.first + i];
  }
  return row;
}

function tip(root, point) {
  const box = root.querySelector(".map-tip");
  const { cells, rows } = root;
  const lines = [];
  if (point && cells && cells.inView >= SINGLE) {
    const { clientWidth, clientHeight } = root.querySelector(".map-cells");
    const cell = Math.floor((point[1] / clientHeight) * cells.down) * cells.across + Math.floor((point[0] / clientWidth) * cells.across);
    if (cells.all[cell]) {
      lines.push(`${cells.all[cell]} rows in this cell`);
      if (cells.n[cell]) lines.push(colouring(root).words(cells.sum[cell] / cells.n[cell]));
      if (rows.bits.size) lines.push(`${cells.n[cell]} of them chosen`);
    }
  } else if (point && cells) {
    const row = rowAt(root, point);
    if (row !== null) {
      lines.push(`row ${row.toLocaleString("en-US")}, weight ${short(rows.weight[row - rows.first])}`);
      for (const column of [own(AGE), ...root.given.columns.slice(0, 2)]) {
        const codes = rows.codes(column);
        if (codes && codes[row - rows.first] !== UNKNOWN) lines.push(`${column.name} ${short(valueOf(column, codes[row - rows.first]))}${unitOf(column.name)}`);
      }
      lines.push("a click shows its episode");
    }
  }
  box.hidden = !lines.length;
  if (!lines.length) return;
  box.replaceChildren(...lines.map((words) => element("div", "", words)));
  box.style.transform = `translate(${point[0] + 14}px, ${point[1] + 14}px)`;
}

function wireMap(root) {
  const canvas = root.querySelector(".map-over");
  const at = (event) => {
    const { left, top } = canvas.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  };
  let from = null;
  let last = null;
  canvas.onpointerdown = (event) => {
    if (event.button || !root.view) return;
    canvas.setPointerCapture(event.pointerId);
    [from, last] = [at(event), at(event)];
    root.drawing = root.tool === "move" ? null : [from];
    canvas.focus({ preventScroll: true });
    event.preventDefault();
  };
  canvas.onpointermove = (event) => {
    const point = at(event);
    if (!from) return tip(root, point);
    tip(root, null);
    if (root.tool === "move") pan(root, point[0] - last[0], point[1] - last[1]);
    else if (root.tool === "lasso") root.drawing.push(point);
    else root.drawing = boxOf(from, point);
    last = point;
    if (root.tool !== "move") overAgain(root);
  };
  canvas.onpointerup = (event) => {
    const point = at(event);
    const [start, shape] = [from, root.drawing];
    [from, root.drawing] = [null, null];
    if (!start) return;
    if (Math.hypot(point[0] - start[0], point[1] - start[1]) < CLICK_PX && (shape?.length ?? 0) < 8) {
      const row = rowAt(root, point);
      if (row !== null) root.tell("row", row);
      return draw(root);
    }
    if (root.tool === "move") return;
    if (root.tool === "zoom") {
      const [[x0, y1], [x1, y0]] = [codeAt(root, shape[0]), codeAt(root, shape[2])];
      root.view = { x: [Math.min(x0, x1), Math.max(x0, x1)], y: [Math.min(y0, y1), Math.max(y0, y1)] };
      return draw(root);
    }
    const some = shape.length <= CORNERS ? shape : Array.from({ length: CORNERS }, (_, i) => shape[Math.round((i * (shape.length - 1)) / (CORNERS - 1))]);
    choose(root, { ...root.selection, outline: { plane: root.given.planes[0].key, corners: some.map((corner) => valueAt(root, corner)) } });
  };
  canvas.onpointerleave = () => tip(root, null);
  canvas.ondblclick = () => resetView(root);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (root.view) zoomAt(root, at(event), 1.0015 ** event.deltaY);
  }, { passive: false });
  canvas.onkeydown = (event) => onMapKey(root, event);
}

const boxOf = ([x0, y0], [x1, y1]) => [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];

function resetView(root) {
  root.viewOf = "";
  draw(root);
}

function overAgain(root) {
  const [X, Y] = root.given.planes[0].axes.map(root.rows.codes);
  if (X && Y) drawOver(root, X, Y);
}

function onMapKey(root, event) {
  const { clientWidth, clientHeight } = root.querySelector(".map-cells");
  const middle = [clientWidth / 2, clientHeight / 2];
  const act = {
    ArrowLeft: () => pan(root, 40, 0),
    ArrowRight: () => pan(root, -40, 0),
    ArrowUp: () => pan(root, 0, 40),
    ArrowDown: () => pan(root, 0, -40),
    "+": () => zoomAt(root, middle, 1 / 1.3),
    "=": () => zoomAt(root, middle, 1 / 1.3),
    "-": () => zoomAt(root, middle, 1.3),
    0: () => resetView(root),
    Escape: () => choose(root, { intervals: {}, outline: null }),
  }[event.key];
  if (!act || event.ctrlKey || event.metaKey || !root.view) return;
  event.preventDefault();
  act();
}

// --- Histograms.

function wireHistogram(root, figure) {
  const canvas = figure.querySelector("canvas");
  const column = () => columnNamed(root, figure.dataset.name);
  const rounded = (value) => Number(value.toPrecision(4));
  const shareAt = (event) => {
    const { left, width } = canvas.getBoundingClientRect();
    return Math.min(Math.max((event.clientX - left) / width, 0), 1);
  };
  const clear = () => choose(root, brushed(root, column().name, null));
  // Choose the rows between two shares of the axis; all of it is no brush.
  const brushTo = (...shares) => {
    const [from, to] = shares.map((share) => Math.min(Math.max(share, 0), 1)).sort((a, b) => a - b);
    const interval = [from <= 0.004 ? null : rounded(atShare(column(), from)), to >= 0.996 ? null : rounded(atShare(column(), to))];
    const some = interval.some((end) => end !== null);
    choose(root, brushed(root, column().name, some ? interval : null), { rest: REST_MS });
  };
  const endsOf = (brush) => brush.map((value, i) => (value === null ? i : shareOf(column(), value)));
  let from = null;
  let whole = null; // the brush that is moved, in shares
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    const share = shareAt(event);
    const brush = root.selection.intervals[column().name];
    const ends = brush && endsOf(brush);
    const grip = 6 / canvas.clientWidth;
    whole = null;
    if (ends && Math.abs(share - ends[0]) < grip) from = ends[1];
    else if (ends && Math.abs(share - ends[1]) < grip) from = ends[0];
    else if (ends && share > ends[0] && share < ends[1]) [from, whole] = [share, ends];
    else from = share;
    event.preventDefault();
  };
  canvas.onpointermove = (event) => {
    if (from === null) return;
    const share = shareAt(event);
    const ends = whole ? whole.map((end) => end + share - from) : [from, share];
    if (Math.abs(share - from) * canvas.clientWidth < 2) return;
    brushTo(...ends);
  };
  canvas.onpointerup = (event) => {
    const clicked = from !== null && Math.abs(shareAt(event) - from) * canvas.clientWidth < 2;
    from = null;
    if (clicked && root.selection.intervals[column().name]) clear();
  };
  canvas.onkeydown = (event) => {
    const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (event.key === "Escape" || event.key === "Delete") return clear();
    if (!by) return undefined;
    event.preventDefault();
    const [low, high] = endsOf(root.selection.intervals[column().name] ?? [null, null]);
    return event.shiftKey ? brushTo(low, high + by) : brushTo(low + by, high);
  };
}

function buildHistograms(root) {
  const box = root.querySelector(".map-hists");
  const columns = columnsOf(root);
  const names = columns.map(({ name }) => name);
  if (JSON.stringify(names) === root.built) return;
  root.built = JSON.stringify(names);
  const figures = names.map((name, i) => {
    const figure = element("figure", "map-hist");
    [figure.dataset.name, figure.hidden] = [name, i >= HISTS];
    const head = element("figcaption");
    const note = columns[i].note ?? "";
    head.append(element("span", "", (name === WEIGHT ? "weight (log)" : name) + note), element("output"));
    const canvas = element("canvas");
    Object.entries({ tabindex: "0", role: "group", "aria-label": `Rows by ${name}: drag to choose an interval, or arrows and Shift with arrows; Escape ends it` }).forEach(([key, value]) => canvas.setAttribute(key, value));
    const foot = element("footer");
    foot.append(element("span"), element("span"), element("span"));
    figure.append(head, canvas, foot);
    wireHistogram(root, figure);
    return figure;
  });
  box.replaceChildren(...figures);
  const more = root.querySelector(".map-more");
  more.hidden = names.length <= HISTS;
  more.textContent = `${names.length - HISTS} more dimensions`;
  more.onclick = () => {
    box.querySelectorAll(".map-hist").forEach((figure) => (figure.hidden = false));
    root.measured = false;
    more.hidden = true;
    load(root);
  };
}

function buildHead(root) {
  root.querySelector(".map-presets").replaceChildren(
    ...PRESETS.map(([words, intervals]) => {
      const button = element("button", "", words);
      button.onclick = () => choose(root, { intervals: intervals(), outline: null });
      return button;
    }),
  );
  const tools = root.querySelectorAll(".map-tools button");
  const pick = (tool) => {
    root.tool = tool;
    tools.forEach((button) => button.setAttribute("aria-pressed", button.dataset.tool === tool));
    root.querySelector(".map-over").dataset.tool = tool;
  };
  tools.forEach((button) => (button.onclick = () => pick(button.dataset.tool)));
  pick(root.tool ?? "lasso");
  root.querySelector(".map-colour").onchange = ({ target }) => {
    root.colour = target.value;
    root.tell("colour", target.value);
    draw(root);
  };
  const strip = root.querySelector(".map-strip canvas");
  strip.onpointermove = ({ clientX }) => {
    const { left, width } = strip.getBoundingClientRect();
    const [from, to] = root.given.path;
    root.marked = Math.min(from + Math.floor(((clientX - left) / width) * (to - from + 1)), to);
    overAgain(root);
  };
  strip.onpointerleave = () => {
    root.marked = null;
    overAgain(root);
  };
  strip.onclick = () => root.marked !== null && root.tell("row", root.marked);
}

function fillColours(root) {
  const select = root.querySelector(".map-colour");
  const options = [WEIGHT, ...(root.given.against ? ["against"] : []), AGE, ...root.given.columns.map(({ name }) => name)];
  select.replaceChildren(
    ...options.map((name) => {
      const option = element("option", "", name === "against" ? `against ${root.given.against.label}` : name);
      [option.value, option.selected] = [name, name === root.colour];
      return option;
    }),
  );
  if (!options.includes(root.colour)) root.colour = WEIGHT;
}

// --- Arrays: what is needed first comes first.

async function load(root) {
  const turn = (root.turn = (root.turn ?? 0) + 1);
  const { given } = root;
  const current = () => root.isConnected && root.turn === turn;
  const failed = root.querySelector(".map-failed");
  try {
    const source = given.sources[root.sourceAt];
    if (!source || !given.planes.length) return;
    const axes = given.planes.flatMap((plane) => plane.axes.map(({ url }) => url));
    const [weights] = await Promise.all([source.url, ...axes].map(array));
    if (!current()) return;
    if (root.stale || root.rows?.source.url !== source.url) root.rows = rowsOf(given, source, weights);
    root.stale = false;
    if (given.against) {
      const other = await array(given.against.url);
      if (root.against?.source.url !== given.against.url) root.against = rowsOf(given, given.against, other);
    }
    failed.hidden = true;
    draw(root);
    const urlOf = (name) => (name === DISTANCE ? source.distance : columnNamed(root, name)?.url);
    const shown = [...root.querySelectorAll(".map-hist:not([hidden])")].map(({ dataset }) => dataset.name);
    const chosen = Object.keys(root.selection.intervals);
    const wanted = [...new Set([...chosen, root.colour, ...shown].map(urlOf))].filter(Boolean);
    await Promise.all(wanted.map((url) => Promise.resolve(array(url)).then(() => current() && draw(root))));
    // The other fits, so that the timeline moves without the server.
    for (const url of given.sources.flatMap(({ url, distance }) => [url, distance])) {
      if (url) await array(url);
      if (!current()) return;
    }
    root.dataset.loaded = root.turn;
  } catch (error) {
    if (!current()) return;
    console.error(error);
    failed.textContent = `The rows did not arrive (${error.message}). Reload the page.`;
    failed.hidden = false;
  }
}

// The fit of a step is the last that is not after it.
function sourceOf(given, step) {
  const steps = given.sources.map((source) => source.step);
  if (step === undefined || steps[0] === null) return 0;
  return Math.max(steps.filter((own) => own <= step).length - 1, 0);
}

function followStep({ detail }) {
  for (const root of document.querySelectorAll(".buffer-map")) {
    if (!root.given) continue;
    const at = sourceOf(root.given, detail);
    if (at === root.sourceAt) continue;
    root.sourceAt = at;
    const source = root.given.sources[at];
    const weights = here(source.url);
    if (weights) {
      root.rows = rowsOf(root.given, source, weights);
      drawNow(root); // in the same turn of the browser as all that follows the timeline
    }
    if (!weights || (source.distance && !here(source.distance))) load(root);
  }
}
// This script may be read more than once.
window.removeEventListener("tom:step", window.tomMaps);
window.tomMaps = followStep;
window.addEventListener("tom:step", followStep);

export default function ({ data, parentElement, setTriggerValue }) {
  const root = parentElement.querySelector(".buffer-map");
  const style = getComputedStyle(root);
  root.tell = setTriggerValue;
  root.given = data.given;
  root.colours = data.given.colours;
  root.tables = { diverging: shades(data.given.diverging), sequential: shades(data.given.sequential) };
  // What the hand does here comes before an answer to what it did.
  const words = JSON.stringify([data.where, data.outline]);
  if (words !== root.answered) {
    root.answered = words;
    if (words !== root.told) {
      root.selection = unworded([data.where, data.outline]);
      root.told = words;
    }
  }
  if (data.colour !== root.coloured) root.colour = root.coloured = data.colour; // so Back counts
  // When a fit has come, the timeline, which is drawn later, does not know yet.
  const fits = JSON.stringify(data.given.sources.map(({ step }) => step));
  root.sourceAt = sourceOf(data.given, (fits === root.fits ? window.tomStep : undefined) ?? data.step);
  root.fits = fits;
  root.querySelector(".map-view").style.fontFamily = style.getPropertyValue("--st-font");
  if (!root.wired) {
    buildHead(root);
    wireMap(root);
    const changed = () => {
      root.measured = false;
      draw(root);
    };
    root.watch = new ResizeObserver(changed);
    root.watch.observe(root);
    root.watch.observe(root.querySelector(".map-frame"));
  }
  root.wired = true;
  // Codes count between the ends of a quantity, which move while a buffer grows.
  const ends = ({ name, low, high }) => [name, low, high];
  const scales = JSON.stringify([data.given.columns.map(ends), data.given.planes.map(({ axes }) => axes.map(ends))]);
  if (scales !== root.scales) [root.scales, root.stale, root.viewOf] = [scales, true, ""];
  buildHistograms(root);
  fillColours(root);
  root.measured = false;
  const named = [...data.given.columns, ...data.given.sources, ...data.given.planes.flatMap(({ axes }) => axes), data.given.against];
  forgetAllBut(new Set(named.filter(Boolean).flatMap(({ url, distance }) => [url, distance])));
  load(root);
}
