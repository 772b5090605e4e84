// Draws a Plotly figure into an element that outlives its data (app/parts/plot/__init__.py).

function library(path) {
  window.tomPlotly ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = path;
    script.onload = () => resolve(window.Plotly);
    script.onerror = () => {
      window.tomPlotly = undefined; // the next chart tries again
      reject(new Error(`cannot load ${path}`));
    };
    document.head.appendChild(script);
  });
  return window.tomPlotly;
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

// A picture has the page's background: on none, a dark page's pale text could not be read.
function save(plot, format) {
  const picture = {
    data: plot.data,
    layout: { ...plot.layout, paper_bgcolor: theme(plot)("background-color") },
  };
  const name = plot.getAttribute("aria-label").replace(/[^\w-]+/g, "-").slice(0, 80);
  const { width, height } = plot.getBoundingClientRect();
  const file = { format, width, height, scale: 2, filename: name };
  window.Plotly.downloadImage(picture, file).catch(say(plot, "The chart cannot be saved"));
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

function options(Plotly, selects, views) {
  const button = (format) => ({
    name: `save as ${format.toUpperCase()}`,
    icon: format === "png" ? Plotly.Icons.camera : Plotly.Icons.disk,
    click: (plot) => save(plot, format),
  });
  return {
    displaylogo: false,
    responsive: true,
    // A zoom that came from the address is none to go back to.
    doubleClick: views ? "autosize" : "reset+autosize",
    modeBarButtonsToRemove: [
      ...["sendChartToCloud", "toImage", views ? "resetScale2d" : "autoScale2d"],
      ...(selects ? [] : ["select2d", "lasso2d"]),
    ],
    modeBarButtonsToAdd: [button("png"), button("svg")],
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

function corners({ range, lassoPoints }) {
  const [x, y] = Object.values(lassoPoints ?? range ?? { x: [], y: [] });
  if (lassoPoints || !x.length) return x.map((value, i) => [value, y[i]]);
  return [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]];
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

// The lines that the legend has switched off, by their uid.
function hiddenLines({ _fullData }) {
  const off = _fullData.filter(({ visible, showlegend }) => visible === "legendonly" && showlegend);
  return off.map(({ uid }) => uid);
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
    line.style.cssText = `height:${_size.h}px;top:${_size.t}px;transform:translateX(${xaxis._offset + at}px)`;
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
  let told = "";
  const select = (region) => {
    // Plotly reports a selection again when it draws it again.
    if (told === JSON.stringify(region)) return;
    told = JSON.stringify(region);
    plot.tell("selected", region);
  };
  plot.on("plotly_click", ({ points, event }) =>
    plot.tell("clicked", place(nearest(plot, points, event))),
  );
  plot.on("plotly_selected", (event) => {
    if (!plot.selects || !event) return;
    const points = event.points.map(({ curveNumber, pointIndex }) => [curveNumber, pointIndex]);
    select({ points, outline: corners(event) });
  });
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
  plot.on("plotly_restyle", () => plot.hides && plot.tell("hidden", hiddenLines(plot)));
  plot.on("plotly_deselect", () => plot.selects && select({ points: [], outline: [] }));
  plot.watch ??= new ResizeObserver(() => {
    // A chart on a hidden tab has no width until it is shown.
    if (plot.wired && plot.isConnected && plot.clientWidth) Plotly.Plots.resize(plot);
  });
  plot.watch.observe(plot);
}

// Shows the state of the page's timeline: a cursor at its step, and the traces' values at the last
// of the figure's own steps that is not after it.
function follow(plot, step) {
  const { cursor, steps, traces } = plot.follows ?? {};
  if (step === undefined || !plot.wired) return;
  const mark = plot.parentElement.querySelector(".plot-cursor");
  mark.hidden = !cursor;
  if (cursor) {
    const { xaxis, _size } = plot._fullLayout;
    const x = xaxis.d2p(step);
    mark.hidden = !(x >= 0 && x <= xaxis._length);
    mark.style.cssText = `height:${_size.h}px;top:${_size.t}px;transform:translateX(${xaxis._offset + x}px)`;
  }
  if (!traces) return;
  const at = Math.max(steps.filter((own) => own <= step).length - 1, 0);
  if (at === plot.frame) return;
  plot.frame = at;
  for (const { index, y } of traces) plot.data[index].y = y[at];
  window.Plotly.redraw(plot);
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
  plot.selects = data.selects;
  plot.hides = data.hides;
  plot.follows = data.follows;
  plot.linked = data.linked;
  plot.viewed ??= [];
  if (data.view) take(plot, data.view);
  plot.setAttribute("aria-label", data.label);
  library(data.library)
    .then(async (Plotly) => {
      if (!plot.isConnected) return;
      const { data: traces, layout } = JSON.parse(data.figure);
      const seen = plot.taken ? zoomed(layout, plot.taken) : layout;
      plot.parentElement.querySelector(".plot-failed").hidden = true;
      // Plotly starts anew, zoom lost, when it gets other options: also other, equal functions.
      plot.options ??= options(Plotly, data.selects, Boolean(data.view));
      const drawn = Plotly.react(plot, traces, dressed(seen, theme(plot)), plot.options);
      if (!plot.wired) wire(plot, Plotly);
      plot.wired = true;
      await drawn;
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
