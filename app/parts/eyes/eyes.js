// Groups and their runs with an eye each (app/parts/eyes/__init__.py).

const OPEN = "M12 5C6 5 2.5 10 2 12c.5 2 4 7 10 7s9.5-5 10-7c-.5-2-4-7-10-7Z";
const PUPIL = "M12 9a3 3 0 1 0 0 6 3 3 0 0 0 0-6Z";
const SHUT = "M3 10c1.5 3 5 5 9 5s7.5-2 9-5M5 14l-2 2.5M12 15v3.5M19 14l2 2.5";
const DASHES = {
  solid: "", dash: "5 3", dot: "1.5 3", dashdot: "5 2.5 1.5 2.5", longdash: "9 4", longdashdot: "9 2.5 1.5 2.5",
};

function make(name, className, text = "") {
  const element = document.createElement(name);
  element.className = className;
  // A setting's name breaks at its dots and underscores, before a word of it does.
  text.split(/(?<=[._])/).forEach((part, i) => {
    element.append(...(i ? [document.createElement("wbr"), part] : [part]));
  });
  return element;
}

function drawing(box, width, paths) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", box);
  svg.setAttribute("width", width);
  svg.setAttribute("aria-hidden", "true");
  for (const attributes of paths) {
    const path = document.createElementNS(svg.namespaceURI, "path");
    for (const [name, value] of Object.entries(attributes)) path.setAttribute(name, value);
    svg.append(path);
  }
  return svg;
}

function eye(name, hidden, click) {
  const button = make("button", "eye");
  const pen = { fill: "none", stroke: "currentColor", "stroke-width": 1.8, "stroke-linecap": "round" };
  button.append(drawing("0 0 24 24", 18, (hidden ? [SHUT] : [OPEN, PUPIL]).map((d) => ({ d, ...pen }))));
  button.type = "button";
  button.title = `${hidden ? "Show" : "Hide"} ${name}`;
  button.setAttribute("aria-label", button.title);
  button.setAttribute("aria-pressed", String(!hidden));
  button.onclick = click;
  return button;
}

function line({ colour, dash }) {
  const pen = { d: "M1 5H23", stroke: colour, "stroke-width": 3, "stroke-dasharray": DASHES[dash] };
  return drawing("0 0 24 10", 24, [pen]);
}

function item(run, off, tell) {
  const row = make("div", run.hidden || off ? "run off" : "run");
  const name = make("span", "name", run.name);
  name.title = run.run_id;
  const button = eye(run.name, run.hidden || off, () => tell(run.run_id));
  button.disabled = off; // with its group, whose eye opens it
  row.append(button, name);
  return row;
}

function group(root, given, tell) {
  const box = make("div", given.hidden ? "group off" : "group");
  const head = make("div", "head");
  const left = given.runs.filter(({ hidden }) => !hidden).length;
  const all = given.runs.length;
  const name = make("button", "name", given.title);
  const open = root.unfolded.has(given.title);
  name.type = "button";
  name.title = `${given.title}: ${open ? "fold its runs" : "show its runs"}`;
  name.setAttribute("aria-expanded", String(open));
  name.onclick = () => {
    root.unfolded[open ? "delete" : "add"](given.title);
    draw(root);
  };
  const count = make("span", "count", left < all ? `${left}/${all}` : String(all));
  count.title = `${left} of ${all} runs`;
  head.append(eye(given.title, given.hidden, () => tell(given.title)), line(given), name, count);
  box.append(head, ...(open ? given.runs.map((run) => item(run, given.hidden, tell)) : []));
  return box;
}

function draw(root) {
  const tell = (word) => root.tell("toggled", [word]);
  const hidden = root.groups.flatMap(({ hidden, runs }) => [hidden, ...runs.map((r) => r.hidden)]);
  const all = make("button", "all", "Show all");
  all.type = "button";
  all.hidden = !hidden.some(Boolean);
  all.onclick = () => root.tell("everything", []);
  root.replaceChildren(...root.groups.map((given) => group(root, given, tell)), all);
}

export default function ({ data, parentElement, setTriggerValue }) {
  const root = parentElement.querySelector(".eyes");
  root.tell = setTriggerValue;
  root.groups = data.groups;
  root.unfolded ??= new Set();
  draw(root);
}
