// Numbers that follow the timeline (app/parts/timeline/__init__.py).

function show(root, step) {
  const { steps, numbers } = root.given;
  const at = step === undefined ? steps.length - 1 : Math.max(steps.filter((s) => s <= step).length - 1, 0);
  root.querySelectorAll("dd").forEach((value, i) => (value.textContent = numbers[i].values[at]));
}

function followAll({ detail }) {
  for (const root of document.querySelectorAll(".readout")) if (root.given) show(root, detail);
}
// This script may be read more than once.
if (!window.tomReadouts) window.addEventListener("tom:step", followAll);
window.tomReadouts = followAll;

export default function ({ data, parentElement }) {
  const root = parentElement.querySelector(".readout");
  root.given = data;
  root.replaceChildren(
    ...data.numbers.map(({ label, help }) => {
      const [box, name, value] = ["div", "dt", "dd"].map((kind) => document.createElement(kind));
      name.textContent = label;
      box.title = help;
      if (help) name.className = "helped";
      box.append(name, value);
      return box;
    }),
  );
  show(root, window.tomStep);
}
