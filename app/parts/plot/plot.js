// Draws a Plotly figure into an element that outlives its data (app/parts/plot/__init__.py).

async function library(path) {
  if (!window.Plotly) await import(new URL(path, document.baseURI));
  return window.Plotly;
}

// Plotly takes a second of the page's only thread. So it is loaded when the rest of the page is there,
// and a chart that comes after another part lets that draw first: three seconds later at most.
async function turn(after) {
  const coming = [after, "[data-test-script-state=running]", "[data-testid=stSkeleton]"].filter(Boolean);
  const begun = performance.now();
  while (performance.now() - begun < 3000) {
    const mayDraw = after ? document.querySelector(`${after}[data-drawn]`) : window.Plotly;
    if (mayDraw || !document.querySelector(coming.join())) return;
    await new Promise((go) => setTimeout(go, 20));
  }
}

// The page's own colours and font, which Streamlit offers as CSS variables.
function theme(element) {
  const style = getComputedStyle(element);
  return (name) => style.getPropertyValue(`--st-${name}`).trim();
}

function dressed(layout, value) {
  const font = { color: value("text-color"), family: value("font") };
  return {
    ...layout,
    autosize: true,
    font: { ...layout.font, ...font },
    hoverlabel: {
      bgcolor: value("secondary-background-color"),
      bordercolor: value("border-color"),
      font,
      namelength: -1,
    },
    modebar: {
      bgcolor: "rgba(0,0,0,0)",
      color: value("text-color"),
      activecolor: value("primary-color"),
    },
  };
}

// --- Saving: a file as the page shows it, or drawn anew for a paper (app/figures/paper.py).

const WIDTHS = { shown: "as shown", one: "one column, 8.6 cm", two: "two columns, 17.8 cm" };

function saveBox(plot) {
  let box = plot.parentElement.querySelector("dialog");
  if (!box) {
    box = document.createElement("dialog");
    box.className = "plot-save";
    box.setAttribute("aria-label", "Save this figure");
    // The form keeps the widths of this figure apart from those of others.
    box.innerHTML = `<form method="dialog"><h2>Save this figure</h2>
      <fieldset><legend>Width</legend>${Object.entries(WIDTHS)
        .map(([key, words], i) => `<label><input type="radio" name="width" value="${key}" ${i ? "" : "checked"}> ${words}</label>`)
        .join("")}</fieldset>
      <div class="files">${["svg", "pdf", "png", "csv"]
        .map((kind) => `<button type="button" data-kind="${kind}">${kind.toUpperCase()}</button>`)
        .join("")}</div>
      <p class="caption"></p>
      <button type="button" class="copy">Copy the caption</button><button>Close</button></form>`;
    plot.parentElement.append(box);
    box.querySelectorAll("[data-kind]").forEach((button) => {
      button.onclick = () => {
        const width = box.querySelector("input:checked").value;
        save(plot, button.dataset.kind, width).catch(say(plot, "The chart cannot be saved"));
      };
    });
    box.querySelector(".copy").onclick = () => navigator.clipboard?.writeText(box.querySelector(".caption").textContent);
  }
  box.querySelector(".caption").textContent = plot.caption || plot.getAttribute("aria-label");
  box.showModal();
}

async function save(plot, kind, width) {
  if (kind === "csv") return download(plot, new Blob([csv(plot)], { type: "text/csv" }), kind);
  // A PDF of the page's own look would be a picture of pixels, so it is drawn as for a paper.
  if (width === "shown" && kind !== "pdf") {
    // A picture has the page's background: on none, a dark page's pale text could not be read.
    const layout = { ...plot.layout, paper_bgcolor: theme(plot)("background-color") };
    const size = { width: plot.clientWidth, height: plot.clientHeight, scale: 2 };
    const url = await window.Plotly.toImage({ data: plot.data, layout }, { format: kind, ...size });
    return download(plot, await (await fetch(url)).blob(), kind);
  }
  const column = width === "shown" ? "two" : width;
  const body = JSON.stringify(shown(plot));
  const answer = await fetch(`api/figure?kind=${kind}&width=${column}`, { method: "POST", body });
  if (!answer.ok) throw new Error(await answer.text());
  return download(plot, await answer.blob(), kind);
}

function download(plot, blob, kind) {
  const link = document.createElement("a");
  const name = plot.getAttribute("aria-label").replace(/[^\w-]+/g, "-").slice(0, 80);
  [link.href, link.download] = [URL.createObjectURL(blob), `${name}.${kind}`];
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href));
}

// Plotly gives an axis without a title an invitation to write one.
const titled = (title) => (title?.text && !title.text.startsWith("Click to enter") ? title.text : "");

const drawnTraces = (plot) =>
  plot._fullData.filter(({ visible, type }) => visible === true && ["scatter", "scattergl", "bar", "heatmap", "waterfall"].includes(type));

// A label of Plotly's, which is HTML, in plain words (app/text.py escapes it).
const LETTERS = { amp: "&", lt: "<", gt: ">", quot: '"', "#x27": "'" };
const plain = (label) => label.replace(/<[^>]*>/g, " ").replace(/&(amp|lt|gt|quot|#x27);/g, (_, name) => LETTERS[name]);

// The title of an axis, or of one that goes with it: panels that share an axis have its title once.
function titleOf({ layout }, id) {
  const axes = Object.entries(layout).filter(([name]) => name.startsWith(`${id[0]}axis`));
  const group = ([name, axis]) => axis.matches ?? name.replace("axis", "");
  const own = axes.find(([name]) => name.replace("axis", "") === id);
  const alike = own ? [own, ...axes.filter((one) => group(one) === group(own))] : [];
  return alike.map(([, { title }]) => titled(title)).find(Boolean) ?? "";
}

// Every drawn number, one line each, with the name of its trace, its group and the group's preset; a
// hollow line once.
function csv(plot) {
  // A spreadsheet takes no text for a formula (as tom/harmless.py).
  const harmless = (words) => (/^[=+\-@\t\r]./s.test(words) && Number.isNaN(Number(words)) ? `'${words}` : words);
  const worded = (value) => (typeof value === "string" ? harmless(plain(value)) : value);
  const quoted = (value) => (/[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : value);
  const { y: named, groups, floor } = plot.layout.meta ?? {};
  const drawn = drawnTraces(plot).filter(({ name }) => name !== "core");
  const titles = drawn.map(({ xaxis, yaxis }) => [titleOf(plot, xaxis) || "x", titleOf(plot, yaxis) || named || "y"]);
  // Where panels have unlike axes, each line says what its numbers are.
  const unlike = new Set(titles.map(String)).size > 1;
  const axes = unlike ? ["x", "y"] : (titles[0] ?? ["x", "y"]);
  const both = drawn.some(({ error_y }) => error_y?.array);
  const head = ["line", "group", "preset", ...(unlike ? ["x is", "y is"] : []), ...axes, "value", "low", "high", ...(both ? [`${axes[1]}, low`, `${axes[1]}, high`] : [])];
  const rows = drawn.flatMap((trace, t) => {
    const { name, x, z, customdata, text } = trace;
    const y = floor ? customdata : trace.y; // smaller numbers are drawn at the floor
    const of = [...(groups?.[trace.legendgroup] ?? ["", ""]), ...(unlike ? titles[t] : [])];
    if (z) return [...(customdata ?? z)].flatMap((row, j) => [...row].map((value, i) => [name, ...of, x[i], y[j], value, "", ""]));
    // A band goes along its upper edge, and back along the lower one.
    const edge = (i) => (trace.fill === "toself" ? (i < x.length / 2 ? ", high" : ", low") : "");
    const ends = (bars, at, i) => (bars?.array?.[i] || bars?.arrayminus?.[i] ? [at - bars.arrayminus[i], at + bars.array[i]] : ["", ""]);
    const called = (i) => (Array.isArray(text) && !trace.measure ? text[i] : name + edge(i));
    return [...(x ?? [])].map((at, i) => [called(i), ...of, at, y[i], "", ...ends(trace.error_x, at, i), ...(both ? ends(trace.error_y, y[i], i) : [])]);
  });
  return [head, ...rows].map((row) => row.map((value) => quoted(worded(value ?? ""))).join(",")).join("\n");
}

// What a drawing for a paper needs, in plain numbers.
function shown(plot) {
  const full = plot._fullLayout;
  const axis = ({ range, type, domain, title, tickvals, ticktext, tickmode, _categories }) => {
    const ticks = type === "category" ? [_categories.map((_, i) => i), _categories] : tickmode === "array" ? [tickvals ?? [], ticktext ?? []] : null;
    return { range, type, domain, title: titled(title), tickvals: ticks && [...ticks[0]], ticktext: ticks && [...ticks[1]] };
  };
  const axes = {};
  const traces = drawnTraces(plot).map((t) => {
    const key = `${t.xaxis}${t.yaxis}`;
    axes[key] ??= { x: axis(full[t.xaxis.replace("x", "xaxis")]), y: axis(full[t.yaxis.replace("y", "yaxis")]) };
    if (t.yaxis === "y") axes[key].y.title ||= plot.layout.meta?.y ?? "";
    return {
      axes: key, type: t.type === "scattergl" ? "scatter" : t.type, name: t.name ?? "", y: [...(t.y ?? [])],
      x: axes[key].x.type === "category" ? t.x.map((_, i) => i) : [...(t.x ?? [])],
      // Of a waterfall: what each bar is, and the colours of bars that rise, fall and stand.
      measure: t.measure ? [...t.measure] : null, tints: t.measure ? [t.increasing, t.decreasing, t.totals].map(({ marker }) => marker.color) : null,
      z: t.z ? [...t.z].map((row) => [...row]) : null, mode: t.mode ?? "lines", opacity: t.opacity ?? 1,
      colour: one(t.line?.color) ?? one(t.marker?.color) ?? "#444444", width: t.line?.width ?? 1, dash: t.line?.dash ?? "solid",
      shape: t.line?.shape ?? "linear", symbol: one(t.marker?.symbol) ?? "circle", size: one(t.marker?.size) ?? 4,
      fill: t.fill && t.fill !== "none" ? t.fillcolor : null, showlegend: Boolean(t.showlegend && full.showlegend),
      marks: Array.isArray(t.marker?.symbol) ? t.marker.symbol.map((symbol, i) => [symbol, t.marker.color[i]]) : null,
      bars: reach(t.error_x), upright: reach(t.error_y),
      colorscale: t.colorscale ?? null, zmin: t.zmin ?? null, zmax: t.zmax ?? null,
      ticks: t.showscale && t.colorbar?.tickvals ? { tickvals: [...t.colorbar.tickvals], ticktext: [...(t.colorbar.ticktext ?? t.colorbar.tickvals)] } : null,
    };
  });
  const annotations = (full.annotations ?? []).map(({ text, x, y, xref, yref }) => ({ text, x, y, xref, yref }));
  const shapes = (full.shapes ?? []).filter(({ type }) => type === "line").map(({ x0, x1, y0, y1, xref, yref, line }) => ({
    x0, x1, y0, y1, axes: `${xref}${yref}`.replace(" domain", ""), dash: line?.dash,
  }));
  return { traces, axes, annotations, shapes, legend: full.showlegend, ratio: plot.clientHeight / plot.clientWidth };
}

function reach(bars) {
  return bars?.array ? { array: [...bars.array], arrayminus: [...bars.arrayminus], color: bars.color } : null;
}

function one(value) {
  return Array.isArray(value) || ArrayBuffer.isView(value) ? value[0] : value;
}

// Puts above the chart that something failed, until it is drawn anew.
function say(plot, what) {
  return (error) => {
    console.error(error);
    const words = plot.parentElement.querySelector(".plot-failed");
    words.textContent = `${what}: ${error?.message ?? error}`;
    words.hidden = false;
  };
}

function options(Plotly, views) {
  return {
    displaylogo: false,
    responsive: true,
    // A zoom that came from the address is none to go back to.
    doubleClick: views ? "autosize" : "reset+autosize",
    modeBarButtonsToRemove: [
      ...["sendChartToCloud", "toImage", "select2d", "lasso2d"],
      views ? "resetScale2d" : "autoScale2d",
    ],
    modeBarButtonsToAdd: [
      { name: "Save: SVG, PDF, PNG, CSV", icon: Plotly.Icons.disk, click: saveBox },
    ],
  };
}

function place({ x, y, pointNumber, data }) {
  return { x, y, index: pointNumber, meta: data.meta ?? null };
}

// Of all points under one label, that which lies nearest to the pointer.
function nearest(plot, points, { clientY }) {
  const top = plot.getBoundingClientRect().top;
  const away = ({ y, yaxis }) =>
    yaxis ? Math.abs(yaxis._offset + yaxis.d2p(y) - (clientY - top)) : 0;
  return points.reduce((best, point) => (away(point) < away(best) ? point : best));
}

// What part of each axis is shown, in the figure's units; null for all of it.
function shownPart({ _fullLayout: { xaxis, yaxis } }) {
  const part = ({ autorange, range, type }) =>
    autorange ? null : range.map((at) => Number((type === "log" ? 10 ** at : at).toPrecision(5)));
  return xaxis && yaxis ? { x: part(xaxis), y: part(yaxis) } : null;
}

// A view from the page counts when it is another than the last, but for an answer to what the
// reader has done here: by then the reader may be further on.
function take(plot, view) {
  const words = JSON.stringify(view);
  if (words === plot.given) return;
  plot.given = words;
  const answered = plot.viewed.indexOf(words);
  if (answered >= 0) plot.viewed.splice(0, answered + 1);
  else {
    plot.viewed = [];
    plot.taken = { view, count: (plot.taken?.count ?? 0) + 1 };
  }
}

function zoomed(layout, { view, count }) {
  const axis = (given, part) => {
    const on = given?.type === "log" && part ? part.map((at) => Math.log10(at)) : part;
    const range = on && on.every(Number.isFinite) ? { range: on, autorange: false } : {};
    return { ...given, ...range, uirevision: `${layout.uirevision} ${count}` };
  };
  return { ...layout, xaxis: axis(layout.xaxis, view.x), yaxis: axis(layout.yaxis, view.y) };
}

// The other charts on the page that share this one's x axis.
function linked(plot) {
  const others = [...document.querySelectorAll(".plot")];
  return others.filter((other) => other !== plot && other.wired && plot.linked && other.linked === plot.linked);
}

// A thin line in every linked chart where the pointer is in one of them.
function crosshair(plot, x) {
  for (const other of linked(plot)) {
    const line = other.parentElement.querySelector(".plot-crosshair");
    const { xaxis, _size } = other._fullLayout;
    const at = x === null ? -1 : xaxis.d2p(x);
    line.hidden = !(at >= 0 && at <= xaxis._length);
    stand(line, _size, xaxis._offset + at);
  }
}

// What was zoomed along x here is zoomed in the linked charts, before the server hears of it.
function spreadZoom(plot, event, Plotly) {
  const range = ["xaxis.range[0]", "xaxis.range[1]"].map((key) => event[key]);
  const change = event["xaxis.autorange"] ? { "xaxis.autorange": true } : { "xaxis.range": range };
  if (!event["xaxis.autorange"] && range.includes(undefined)) return;
  for (const other of linked(plot)) {
    other.quiet = true;
    Plotly.relayout(other, change).finally(() => (other.quiet = false));
  }
}

function wire(plot, Plotly) {
  plot.on("plotly_click", ({ points, event }) =>
    plot.tell("clicked", place(nearest(plot, points, event))),
  );
  plot.on("plotly_afterplot", () => plot.follows?.cursor && follow(plot, window.tomStep));
  plot.on("plotly_hover", ({ xvals }) => crosshair(plot, xvals?.[0] ?? null));
  plot.on("plotly_unhover", () => crosshair(plot, null));
  plot.on("plotly_relayout", (event) => {
    if (plot.quiet) return; // it follows another
    spreadZoom(plot, event, Plotly);
    const view = plot.taken && shownPart(plot);
    const words = JSON.stringify(view);
    if (!view || words === (plot.viewed.at(-1) ?? plot.given)) return;
    plot.viewed.push(words);
    plot.tell("viewed", view);
  });
  plot.watch ??= new ResizeObserver(() => {
    // A chart on a hidden tab has no width until it is shown.
    if (plot.wired && plot.isConnected && plot.clientWidth) Plotly.Plots.resize(plot);
  });
  plot.watch.observe(plot);
}

// Puts an upright line at `x`, in pixels of the chart. Only what has changed is set: a move alone
// costs no layout.
function stand(line, { t, h }, x) {
  const at = { height: `${h}px`, top: `${t}px`, transform: `translateX(${x}px)` };
  for (const [name, value] of Object.entries(at)) if (line.style[name] !== value) line.style[name] = value;
}

// Shows the state of the page's timeline: a cursor at its step, and the first trace as it was at the
// last of its own steps that is not after it.
function follow(plot, step) {
  const { cursor, trace } = plot.follows ?? {};
  if (step === undefined || !plot.wired) return;
  const mark = plot.parentElement.querySelector(".plot-cursor");
  mark.hidden = !cursor;
  if (cursor) {
    const { xaxis, _size } = plot._fullLayout;
    const x = xaxis.d2p(step);
    mark.hidden = !(x >= 0 && x <= xaxis._length);
    stand(mark, _size, xaxis._offset + x);
  }
  if (!trace) return;
  const steps = Object.keys(trace); // ascending, as they are whole numbers
  const at = steps.findLast((own) => Number(own) <= step) ?? steps[0];
  if (at === plot.frame) return;
  plot.frame = at;
  Object.assign(plot.data[0], trace[at]);
  if (!moveBars(plot, plot.data[0].y)) return window.Plotly.redraw(plot);
  // What hovering shows comes with a whole drawing, once nothing has moved for a moment.
  clearTimeout(plot.later);
  plot.later = setTimeout(() => plot.isConnected && plot.wired && window.Plotly.redraw(plot), 400);
}

// Gives the bars of the first trace other heights, in a hundredth of the time of a whole drawing;
// false if it has no such bars.
function moveBars(plot, y) {
  const { type, x, width } = plot._fullData[0];
  const bars = plot.querySelector(".barlayer .trace")?.querySelectorAll(".point path");
  if (type !== "bar" || !width || bars?.length !== y.length) return false;
  const { xaxis, yaxis } = plot._fullLayout;
  const base = yaxis.type === "log" ? yaxis._length : yaxis.d2p(0);
  bars.forEach((bar, i) => {
    const [left, right] = [xaxis.d2p(x[i] - width / 2), xaxis.d2p(x[i] + width / 2)];
    bar.setAttribute("d", `M${left},${base}V${yaxis.d2p(y[i])}H${right}V${base}Z`);
  });
  return true;
}

function followAll({ detail }) {
  for (const plot of document.querySelectorAll(".plot")) if (plot.follows) follow(plot, detail);
}
// This script may be read more than once.
if (!window.tomFollowAll) window.addEventListener("tom:step", followAll);
window.tomFollowAll = followAll;

export default function ({ data, parentElement, setTriggerValue }) {
  const plot = parentElement.querySelector(".plot");
  plot.tell = setTriggerValue;
  plot.follows = data.follows;
  plot.linked = data.linked;
  plot.viewed ??= [];
  if (data.view) take(plot, data.view);
  plot.setAttribute("aria-label", data.label);
  plot.caption = data.caption;
  turn(data.after)
    .then(() => library(data.library))
    .then(async (Plotly) => {
      if (!plot.isConnected) return;
      const { data: traces, layout } = JSON.parse(data.figure);
      const seen = plot.taken ? zoomed(layout, plot.taken) : layout;
      plot.parentElement.querySelector(".plot-failed").hidden = true;
      // Plotly starts anew, zoom lost, when it gets other options: also other, equal functions.
      plot.options ??= options(Plotly, Boolean(data.view));
      await Plotly.react(plot, traces, dressed(seen, theme(plot)), plot.options);
      if (!plot.wired) wire(plot, Plotly);
      plot.wired = true;
      plot.frame = undefined;
      follow(plot, window.tomStep);
    })
    .catch((error) => {
      if (!plot.isConnected) return;
      // What was drawn before is of other data.
      window.Plotly?.purge(plot);
      plot.wired = false;
      say(plot, "The chart cannot be drawn")(error);
    });
  return () => setTimeout(() => plot.isConnected || window.Plotly?.purge(plot));
}
