// The page's one timeline (app/parts/timeline/__init__.py). Every panel that follows it listens to
// `tom:step` on the window, whose detail is the env step; the server hears of it when the hand
// stops.

const PLAY = "M7 4.5v15l12.5-7.5Z";
const PAUSE = "M6 4.5h4.2v15H6Zm7.8 0H18v15h-4.2Z";
const WHOLE_MS = 4500; // a run from its first to its last stop, so 120 fits pass at 27 a second
const LEAST_MS = 120; // of a stop: few stops pass more slowly
const REST_MS = 350; // without a move: the hand has stopped

const words = (step) => step.toLocaleString("en-US");

function draw(root) {
  const { stops, fits, evaluations } = root.given;
  const [first, last] = [stops[0], stops.at(-1)];
  const place = (step) => (last > first ? (100 * (step - first)) / (last - first) : 100);
  const marks = (steps, name) =>
    steps.map((step) => `<i class="${name}" style="left:${place(step).toFixed(3)}%"></i>`).join("");
  root.querySelector(".marks").innerHTML = marks(fits, "fit") + marks(evaluations, "evaluation");
  const range = root.querySelector("input");
  [range.min, range.max, range.disabled] = [0, stops.length - 1, stops.length < 2];
  root.querySelector("button").disabled = stops.length < 2;
  root.place = place;
}

// Show the stop of index `i`, here and in every panel.
function show(root, i) {
  root.at = Math.min(Math.max(i, 0), root.given.stops.length - 1);
  const step = root.given.stops[root.at];
  const range = root.querySelector("input");
  range.value = root.at;
  range.setAttribute("aria-valuetext", `step ${words(step)}`);
  root.querySelector(".hand").style.left = `${root.place(step)}%`;
  root.querySelector("output").textContent = `step ${words(step)}`;
  window.tomStep = step;
  window.dispatchEvent(new CustomEvent("tom:step", { detail: step }));
}

function tell(root) {
  clearTimeout(root.rest);
  const step = root.given.stops[root.at];
  if (step === root.told) return;
  root.told = step;
  root.setStep("step", step);
}

// Move to a stop, and tell the server when nothing has moved for a moment.
function move(root, i) {
  show(root, i);
  clearTimeout(root.rest);
  root.rest = setTimeout(() => tell(root), REST_MS);
}

function play(root, on) {
  root.playing = on;
  root.querySelector("path").setAttribute("d", on ? PAUSE : PLAY);
  root.querySelector("button").setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on) return tell(root);
  const last = root.given.stops.length - 1;
  const from = root.at === last ? 0 : root.at;
  const pace = Math.min(LEAST_MS, WHOLE_MS / Math.max(last, 1));
  let begun;
  const tick = (now) => {
    if (!root.playing || !root.isConnected) return;
    begun ??= now;
    const i = Math.min(from + Math.floor((now - begun) / pace), last);
    if (i !== root.at) show(root, i);
    if (i === last) play(root, false);
    else requestAnimationFrame(tick);
  };
  show(root, from);
  requestAnimationFrame(tick);
}

// The stop whose place on the track is nearest to the pointer.
function under(root, { clientX }) {
  const { left, width } = root.querySelector(".track").getBoundingClientRect();
  const at = (100 * (clientX - left)) / width;
  const away = (i) => Math.abs(root.place(root.given.stops[i]) - at);
  return root.given.stops.reduce((best, _, i) => (away(i) < away(best) ? i : best), 0);
}

function wire(root) {
  root.querySelector("button").onclick = () => play(root, !root.playing);
  const range = root.querySelector("input");
  range.oninput = () => {
    if (root.playing) play(root, false);
    move(root, Number(range.value));
  };
  const track = root.querySelector(".track");
  track.onpointerdown = (event) => {
    if (root.given.stops.length < 2) return;
    if (root.playing) play(root, false);
    track.setPointerCapture(event.pointerId);
    move(root, under(root, event));
    range.focus({ preventScroll: true });
    event.preventDefault();
  };
  track.onpointermove = (event) => {
    if (track.hasPointerCapture(event.pointerId)) move(root, under(root, event));
  };
}

export default function ({ data, parentElement, setTriggerValue }) {
  const root = parentElement.querySelector(".timeline");
  const same = JSON.stringify(root.given) === JSON.stringify(data.given);
  root.setStep = setTriggerValue;
  root.given = data.given;
  if (!root.wired) wire(root);
  root.wired = true;
  if (!same) draw(root);
  // What the hand does here comes before an answer to where it was.
  if (root.playing || (same && data.step === root.answered)) return;
  root.answered = data.step;
  if (same && data.step === root.told) return;
  root.told = data.step;
  show(root, root.given.stops.indexOf(data.step));
}
