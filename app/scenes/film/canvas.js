// What the films share: numbers from base64, colours, robots of capsules, and the clock.

const LOOK = TOLD.look;
const DARK = TOLD.mode === "dark";
const CANVAS = document.querySelector("canvas");
const CTX = CANVAS.getContext("2d");
const TEXT = rgb(LOOK.text);
const FONT = "system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif";
const DECODED = { int16: Int16Array, int32: Int32Array, float32: Float32Array };

function unpacked(text, kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new DECODED[kind](bytes.buffer);
}

function rgb(hex) {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

function mixed(a, b, share) {
  return a.map((value, i) => Math.round(value + (b[i] - value) * share));
}

function css([r, g, b], alpha = 1) {
  return `rgba(${r},${g},${b},${alpha})`;
}

// A table of 256 colours along a scale of [place, hex] stops.
function table(stops) {
  const found = [];
  for (let i = 0; i < 256; i++) {
    const at = i / 255;
    const after = Math.max(stops.findIndex(([place]) => place >= at), 1);
    const [[low, from], [high, to]] = [stops[after - 1], stops[after]];
    found.push(mixed(rgb(from), rgb(to), Math.min(Math.max((at - low) / (high - low), 0), 1)));
  }
  return found;
}

function clamp(x, low = 0, high = 1) {
  return Math.min(Math.max(x, low), high);
}

// The end points of a robot's parts between two frames, in metres: [x, y, z, x, y, z] for each.
function pose(body, frame) {
  const [frames, parts] = body.shape;
  const first = clamp(Math.floor(frame), 0, frames - 1);
  const next = Math.min(first + 1, frames - 1);
  const share = clamp(frame - first);
  const size = parts * 6;
  const found = new Float32Array(size);
  for (let i = 0; i < size; i++) {
    const a = body.numbers[first * size + i];
    found[i] = (a + (body.numbers[next * size + i] - a) * share) / 1000;
  }
  return found;
}

// Draw a robot's parts from the side, a little from above, the far ones first.
function robot(parts, radius, { x, y, scale, colour, alpha = 1, edge }) {
  edge ??= css(mixed(colour, DARK ? [0, 0, 0] : [60, 40, 30], 0.5), 0.8);
  const across = (i) => x + scale * (parts[i] + 0.35 * parts[i + 1]);
  const up = (i) => y - scale * (parts[i + 2] + 0.18 * parts[i + 1]);
  const order = radius.map((_, g) => g);
  order.sort((a, b) => parts[6 * b + 1] + parts[6 * b + 4] - parts[6 * a + 1] - parts[6 * a + 4]);
  CTX.save();
  CTX.globalAlpha = alpha;
  CTX.lineCap = "round";
  for (const g of order) {
    const line = (width, style, lift = 0) => {
      CTX.lineWidth = Math.max(width, 0.6);
      CTX.strokeStyle = style;
      CTX.beginPath();
      CTX.moveTo(across(6 * g), up(6 * g) - lift);
      CTX.lineTo(across(6 * g + 3) + 0.01, up(6 * g + 3) - lift);
      CTX.stroke();
    };
    const thick = (2 * scale * radius[g]) / 1000;
    line(thick + 1.6, edge);
    line(thick, css(colour));
    line(0.35 * thick, css(mixed(colour, [255, 255, 255], 0.35)), 0.2 * thick);
  }
  CTX.restore();
}

const GLOWS = new Map();

// Light round something, drawn once for each colour.
function glow(colour, x, y, size, strength) {
  const key = colour.join();
  if (!GLOWS.has(key)) {
    const small = document.createElement("canvas");
    small.width = small.height = 64;
    const soft = small.getContext("2d");
    const light = soft.createRadialGradient(32, 32, 0, 32, 32, 32);
    light.addColorStop(0, css(colour, 0.9));
    light.addColorStop(0.4, css(colour, 0.35));
    light.addColorStop(1, css(colour, 0));
    soft.fillStyle = light;
    soft.fillRect(0, 0, 64, 64);
    GLOWS.set(key, small);
  }
  CTX.save();
  CTX.globalAlpha = clamp(strength);
  CTX.drawImage(GLOWS.get(key), x - size, y - size, 2 * size, 2 * size);
  CTX.restore();
}

// Play, pause, scrub. `draw(seconds)` draws the film at a time; so does whoever records it.
function play(draw, seconds, { loops = false, begins = true } = {}) {
  const [button, time] = ["button", "input"].map((name) => document.querySelector(name));
  let [at, playing, then] = [0, false, 0];
  const show = () => {
    draw(at);
    time.value = at / seconds;
  };
  const tick = (now) => {
    if (!playing) return;
    at += Math.min((now - then) / 1000, 0.25);
    then = now;
    if (at >= seconds && loops) at = 0;
    if (at >= seconds) set(false);
    at = Math.min(at, seconds);
    show();
    if (playing) requestAnimationFrame(tick);
  };
  const set = (on) => {
    if (on && at >= seconds) at = 0;
    playing = on;
    button.textContent = on ? "❚❚" : "▶";
    then = performance.now();
    if (on) requestAnimationFrame(tick);
  };
  button.onclick = CANVAS.onclick = () => set(!playing);
  time.oninput = () => {
    at = Number(time.value) * seconds;
    show();
  };
  document.onkeydown = (event) => {
    if (event.target !== document.body) return;
    if (event.key === " ") set(!playing);
    const jump = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (jump) at = clamp(at + jump, 0, seconds);
    if (jump) show();
  };
  show();
  if (begins) set(true);
  window.film = { seconds, draw, stop: () => set(false), size: [CANVAS.width, CANVAS.height] };
  offer(window.film);
}
