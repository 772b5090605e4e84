// The list of runs on every page (app/parts/scope.py): groups and their runs, each with
// an eye that shows or hides it; a run's name chooses it, an eye with Alt shows it alone.

const OPEN = "M12 5C6 5 2.5 10 2 12c.5 2 4 7 10 7s9.5-5 10-7c-.5-2-4-7-10-7Z";
const PUPIL = "M12 9a3 3 0 1 0 0 6 3 3 0 0 0 0-6Z";
const SHUT = "M3 10c1.5 3 5 5 9 5s7.5-2 9-5M5 14l-2 2.5M12 15v3.5M19 14l2 2.5";

function make(name, className, text = "") {
  const element = document.createElement(name);
  element.className = className;
  // A setting's name breaks at its dots and underscores, before a word of it does.
  text.split(/(?<=[._])/).forEach((part, i) => {
    element.append(...(i ? [document.createElement("wbr"), part] : [part]));
  });
  return element;
}

function drawing(box, width, height, paths) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const attributes = { viewBox: box, width, height, "aria-hidden": "true" };
  for (const [name, value] of Object.entries(attributes)) svg.setAttribute(name, value);
  for (const pen of paths) {
    const path = document.createElementNS(svg.namespaceURI, "path");
    for (const [name, value] of Object.entries({ fill: "none", ...pen })) path.setAttribute(name, value);
    svg.append(path);
  }
  return svg;
}

function eye(root, word, name, hidden) {
  const button = make("button", "eye");
  const pen = { stroke: "currentColor", "stroke-width": 1.8, "stroke-linecap": "round" };
  button.append(drawing("0 0 24 24", 18, 18, (hidden ? [SHUT] : [OPEN, PUPIL]).map((d) => ({ d, ...pen }))));
  button.title = `${hidden ? "Show" : "Hide"} ${name} (Alt: show it alone)`;
  button.setAttribute("aria-label", `${hidden ? "Show" : "Hide"} ${name}`);
  button.onclick = ({ altKey }) => root.tell(altKey ? "alone" : "toggled", [word]);
  // A browser makes no click of Enter with Alt.
  button.onkeydown = ({ altKey, key }) => {
    if (altKey && key === "Enter") root.tell("alone", [word]);
  };
  return button;
}

// The run's returns, in a box of their own.
function sparkline(values, colour) {
  if (values.length < 2) return "";
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const y = (value) => (high > low ? 14 - (12 * (value - low)) / (high - low) : 8);
  const d = values.map((v, i) => `${i ? "L" : "M"}${((44 * i) / (values.length - 1)).toFixed(1)} ${y(v).toFixed(1)}`);
  return drawing("0 0 44 16", 44, 16, [{ d: d.join(""), stroke: colour, "stroke-width": 1.4 }]);
}

function item(root, run, given) {
  const row = make("div", `run${run.hidden || given.hidden ? " off" : ""}${run.chosen ? " chosen" : ""}`);
  const name = make("button", "name", run.name);
  name.title = `${run.run_id}: ${run.state}`;
  if (run.chosen) name.setAttribute("aria-current", "true");
  name.onclick = () => root.tell("chosen", [run.run_id]);
  const dot = make("i", `dot ${run.state}`);
  row.append(eye(root, run.run_id, run.name, run.hidden || given.hidden), name, sparkline(run.returns, given.colour), dot);
  return row;
}

function group(root, given) {
  const box = make("div", given.hidden ? "group off" : "group");
  const head = make("div", "head");
  const { left, count: all } = given;
  const name = make("button", "name", given.title);
  const key = `${given.section} ${given.title}`;
  const open = root.folds.get(key) ?? given.runs.some(({ chosen }) => chosen);
  name.title = `${given.title}: ${open ? "fold its runs" : "show its runs"}`;
  name.setAttribute("aria-expanded", String(open));
  name.onclick = () => {
    root.folds.set(key, !open);
    draw(root);
  };
  const count = make("span", "count", left < all ? `${left}/${all}` : String(all));
  count.title = `${left} of ${all} runs`;
  const swatch = make("i", "swatch");
  swatch.style.background = given.core || given.colour;
  swatch.style.borderColor = given.colour;
  head.append(eye(root, given.title, given.title, given.hidden), swatch, name, count);
  box.append(head, ...(open ? given.runs.map((run) => item(root, run, given)) : []));
  return box;
}

function folded(root, key, label, rows) {
  const open = root.folds.get(key) ?? false;
  const more = make("button", "more", label);
  more.setAttribute("aria-expanded", String(open));
  more.onclick = () => {
    root.folds.set(key, !open);
    draw(root);
  };
  return [more, ...(open ? rows : [])];
}

function section(root, { title, groups, more }) {
  const box = make("section", "section");
  const drawn = (given) => group(root, { ...given, section: title });
  const shown = groups.filter(({ folded }) => !folded).map(drawn);
  const others = groups.filter(({ folded }) => folded).map(drawn);
  const plural = others.length === 1 ? "1 more group" : `${others.length} more groups`;
  box.append(make("h2", "title", title), ...shown);
  if (others.length) box.append(...folded(root, `more ${title}`, plural, others));
  if (more) box.append(make("p", "note", more));
  return box;
}

// What a button is called, whether what it opens or shuts is open or not.
const called = (button) =>
  button.className + (button.ariaLabel || button.title || button.textContent).replace(/^(Show|Hide) |: (show|fold) its runs$/g, "");

function draw(root) {
  const focused = root.contains(document.activeElement) ? called(document.activeElement) : "";
  const all = make("button", "all", "Show all");
  all.hidden = !root.sections.some(({ groups }) => groups.some((g) => g.hidden || g.runs.some((r) => r.hidden)));
  all.onclick = () => root.tell("everything", []);
  root.replaceChildren(...root.sections.map((given) => section(root, given)), all);
  if (!focused) return;
  [...root.querySelectorAll("button")].find((b) => called(b) === focused)?.focus({ preventScroll: true });
}

export default function ({ data, parentElement, setTriggerValue }) {
  const root = parentElement.querySelector(".runlist");
  root.tell = setTriggerValue;
  root.sections = data.sections;
  root.folds ??= new Map();
  draw(root);
}
