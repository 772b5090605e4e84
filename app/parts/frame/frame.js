// What all pages share in the browser (app/parts/scope.py): shortcuts, the theme, and
// notices of trainings that have ended.

const ALL_KEYS = {
  " ": () => press(".timeline button"),
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  "/": () => document.querySelector('[data-testid="stSidebar"] input[type="text"]')?.focus(),
  "?": () => document.querySelector(".frame dialog")?.showModal(),
};

function press(selector) {
  const button = document.querySelector(selector);
  button?.click();
  return Boolean(button);
}

function step(by) {
  const range = document.querySelector(".timeline input");
  if (!range || range.disabled) return false;
  range.value = Number(range.value) + by;
  range.dispatchEvent(new Event("input"));
  return true;
}

// A key that the focused element takes for itself is not a shortcut.
function taken({ target, ctrlKey, metaKey, altKey }) {
  const own = "input, textarea, select, button, a, summary, [role=slider], [role=grid], [contenteditable], canvas";
  return ctrlKey || metaKey || altKey || target.closest?.(own) || document.querySelector("dialog[open]");
}

// Streamlit draws an open popover at the end of the page, up to fifty stops of Tab from its button.
function intoPopover({ key, shiftKey, target }) {
  if (key !== "Tab" || shiftKey || !target.closest?.('[data-testid="stPopover"]')) return false;
  const first = document.querySelector('[data-testid="stPopoverBody"] :is(button, input, textarea, a, [tabindex="0"])');
  first?.focus();
  return Boolean(first);
}

function onKey(event) {
  if (intoPopover(event)) return event.preventDefault();
  const act = ALL_KEYS[event.key];
  if (act && !taken(event) && act() !== false) event.preventDefault();
}

// A control that is drawn anew, or has done its work and gone, loses the keyboard: its successor
// gets it back, else the page.
let focused = null;
let among = "";

function onFocus({ target }) {
  focused = target.matches?.(":focus-visible") ? target : null;
  const [key] = focused?.closest('[class*="st-key-"]')?.className.match(/st-key-[\w-]+/) ?? [];
  among = key ? `.${key} ${focused.localName}` : "";
}

const nameOf = (control) => control.getAttribute("aria-label") || control.textContent;

function refocus() {
  if (!focused || focused.isConnected || document.activeElement !== document.body) return;
  const alike = among ? [...document.querySelectorAll(among)] : [];
  const again = alike.find((control) => nameOf(control) === nameOf(focused));
  const main = document.querySelector('[data-testid="stMain"]');
  main?.setAttribute("tabindex", "-1");
  (again || main)?.focus({ preventScroll: true });
}

function notify(events) {
  if (!("Notification" in window) || Notification.permission !== "granted") return;
  for (const { title, body } of events) new Notification(title, { body, tag: title });
}

export default function ({ data, parentElement }) {
  const root = parentElement.querySelector(".frame");
  window.tomFrame?.abort();
  const { signal } = (window.tomFrame = new AbortController());
  window.addEventListener("keydown", onKey, { signal });
  window.addEventListener("focusin", onFocus, { signal });
  window.addEventListener("pointerdown", () => (focused = null), { signal });
  const drawn = new MutationObserver(refocus);
  drawn.observe(document.body, { childList: true, subtree: true });
  signal.onabort = () => drawn.disconnect();
  const theme = root.querySelector(".theme");
  theme.hidden = !data.mode;
  const next = data.mode === "dark" ? "Light" : "Dark";
  theme.textContent = `${next} theme`;
  theme.onclick = () => {
    localStorage.setItem("tom-studio-theme", next);
    location.reload();
  };
  root.querySelector(".help").onclick = () => root.querySelector("dialog").showModal();
  const ask = root.querySelector(".ask");
  ask.hidden = !("Notification" in window) || Notification.permission !== "default";
  ask.onclick = async () => {
    await Notification.requestPermission();
    ask.hidden = Notification.permission !== "default";
  };
  // A drawing may come twice.
  const ended = JSON.stringify(data.ended);
  if (ended !== root.told) notify(data.ended);
  root.told = ended;
}
