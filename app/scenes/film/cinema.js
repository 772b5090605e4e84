// Attention cinema: one timeline moves the robots, the weight map, the returns and the buffer.

const WEIGHTS = unpacked(TOLD.weights, "float32"); // log2, (F, bins)
const CLOUD = {
  row: unpacked(TOLD.cloud.row, "int32"),
  x: unpacked(TOLD.cloud.x, "float32"),
  y: unpacked(TOLD.cloud.y, "float32"),
};
for (const body of [TOLD.crowd, ...TOLD.policy]) body.numbers = unpacked(body.ends, "int16");
const COLOURS = table(LOOK.points);
const INK = table(LOOK.map);
const FIRST = TOLD.steps[0];
// The last policy may have been tried after the last fit.
const LAST = Math.max(TOLD.steps.at(-1), ...TOLD.policy.map((episode) => episode.step));
const STAGE = { left: 28, right: 836, edge: 852, floor: 560, top: 96 };
const PANEL = { left: 880, right: 1252 };
const MAP = { ...PANEL, top: 116, bottom: 286 };
const CURVE = { ...PANEL, top: 330, bottom: 446 };
const DOTS = { ...PANEL, top: 490, bottom: 664 };
const DEPTHS = 4;
const INTRO = 0.04; // share of the film that stands still at its beginning, and at its end

const heights = pose(TOLD.crowd, TOLD.crowd.now).filter((_, i) => i % 3 === 2);
const TALL = Math.max(...heights, 0.4);
const SCALE = Math.min(180 / TALL, 240);

function words(text, x, y, size, { align = "left", bold = false, alpha = 1, colour = TEXT } = {}) {
  CTX.font = `${bold ? 650 : 400} ${size}px ${FONT}`;
  CTX.textAlign = align;
  CTX.fillStyle = css(colour, alpha);
  CTX.fillText(text, x, y);
}

// A return: whole, but with two digits where it is small.
function score(value) {
  return number(value, Math.abs(value) < 10 ? 2 : 0);
}

function number(value, digits = 0) {
  return value.toLocaleString("en-US", { maximumFractionDigits: digits });
}

// Where in the list of fits a step lies, with a share of the way to the next one.
function place(step) {
  let low = 0;
  let high = TOLD.steps.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (TOLD.steps[middle] <= step) low = middle;
    else high = middle;
  }
  const span = TOLD.steps[high] - TOLD.steps[low];
  return { fit: low, next: high, share: span ? clamp((step - TOLD.steps[low]) / span) : 0 };
}

// What a transition weighs at a fit, log2: the mean of the part of the buffer that it lies in.
function weightAt(fit, row) {
  const count = TOLD.count[fit];
  const age = (row - (TOLD.rows[fit] - count)) / count;
  if (age < 0 || age >= 1) return null;
  return WEIGHTS[fit * TOLD.bins + Math.floor(age * TOLD.bins)];
}

function weight(at, row) {
  const [before, after] = [weightAt(at.fit, row), weightAt(at.next, row)];
  if (before === null || after === null) return before ?? after;
  return before + (after - before) * at.share;
}

// The rows that there are by now; their number is no step where a loop has left some out.
function recorded(at) {
  return TOLD.rows[at.fit] + (TOLD.rows[at.next] - TOLD.rows[at.fit]) * at.share;
}

function shade(log2) {
  return Math.round(255 * clamp(log2 / (2 * LOOK.octaves) + 0.5));
}

// The whole weight map, drawn once: a column a fit, the newest part of the buffer on top.
const WHOLE_MAP = (() => {
  const [fits, bins] = [TOLD.steps.length, TOLD.bins];
  const small = document.createElement("canvas");
  [small.width, small.height] = [fits, bins];
  const ctx = small.getContext("2d");
  const image = ctx.createImageData(fits, bins);
  for (let f = 0; f < fits; f++) {
    for (let b = 0; b < bins; b++) {
      const at = 4 * ((bins - 1 - b) * fits + f);
      image.data.set([...INK[shade(WEIGHTS[f * bins + b])], 255], at);
    }
  }
  ctx.putImageData(image, 0, 0);
  return small;
})();

function across(box, step) {
  return box.left + ((step - FIRST) / (LAST - FIRST || 1)) * (box.right - box.left);
}

function frame(box, title) {
  words(title, box.left, box.top - 10, 13, { alpha: 0.75 });
  CTX.strokeStyle = LOOK.border;
  CTX.lineWidth = 1;
  CTX.strokeRect(box.left - 0.5, box.top - 0.5, box.right - box.left + 1, box.bottom - box.top + 1);
}

function cursor(box, step) {
  CTX.strokeStyle = css(TEXT, 0.85);
  CTX.lineWidth = 1.5;
  CTX.beginPath();
  CTX.moveTo(across(box, step), box.top);
  CTX.lineTo(across(box, step), box.bottom);
  CTX.stroke();
}

function drawMap(step) {
  frame(MAP, "weight of each part of the buffer, the newest on top");
  const width = across(MAP, step) - MAP.left;
  const height = MAP.bottom - MAP.top;
  const share = width / (MAP.right - MAP.left);
  // Columns are as far apart as their steps; fits come evenly, but for a thinned record.
  for (let f = 0; f < TOLD.steps.length && TOLD.steps[f] <= step; f++) {
    const left = across(MAP, TOLD.steps[f]);
    const right = Math.min(across(MAP, TOLD.steps[f + 1] ?? LAST), across(MAP, step));
    if (right > left) CTX.drawImage(WHOLE_MAP, f, 0, 1, TOLD.bins, left, MAP.top, right - left + 0.6, height);
  }
  if (share < 1) {
    CTX.fillStyle = css(rgb(LOOK.surface), 1);
    CTX.fillRect(MAP.left + width, MAP.top, MAP.right - MAP.left - width, height);
  }
  cursor(MAP, step);
}

function drawReturns(step) {
  frame(CURVE, "return of the policy");
  const { step: steps, value } = TOLD.returns;
  if (!steps.length) return;
  const [low, high] = [Math.min(0, ...value), Math.max(...value)];
  const y = (v) => CURVE.bottom - 6 - ((v - low) / (high - low || 1)) * (CURVE.bottom - CURVE.top - 14);
  const line = (until, style, width) => {
    CTX.strokeStyle = style;
    CTX.lineWidth = width;
    CTX.beginPath();
    steps.forEach((s, i) => {
      if (s <= until) CTX.lineTo(clamp(across(CURVE, s), CURVE.left, CURVE.right), y(value[i]));
    });
    CTX.stroke();
  };
  CTX.lineJoin = "round";
  line(Infinity, css(TEXT, 0.12), 1.5);
  line(step, LOOK.learner, 2.5);
  const now = steps.findLastIndex((s) => s <= step);
  if (now >= 0) {
    const at = [clamp(across(CURVE, steps[now]), CURVE.left, CURVE.right), y(value[now])];
    glow(rgb(LOOK.learner), ...at, 16, 0.7);
    CTX.fillStyle = LOOK.learner;
    CTX.beginPath();
    CTX.arc(...at, 4.5, 0, 7);
    CTX.fill();
    words(score(value[now]), CURVE.right, CURVE.top - 10, 13, { align: "right", bold: true });
  }
  cursor(CURVE, step);
}

function drawCloud(at) {
  frame(DOTS, "the buffer on its two principal components");
  const [lit, newest] = [[], recorded(at)];
  for (let i = 0; i < CLOUD.row.length; i++) {
    if (CLOUD.row[i] >= newest) break;
    const log2 = weight(at, CLOUD.row[i]);
    if (log2 !== null) lit.push([log2, i]);
  }
  lit.sort((a, b) => a[0] - b[0]);
  for (const [log2, i] of lit) {
    const x = DOTS.left + 6 + CLOUD.x[i] * (DOTS.right - DOTS.left - 12);
    const y = DOTS.bottom - 6 - CLOUD.y[i] * (DOTS.bottom - DOTS.top - 12);
    const size = 1.1 + 0.45 * clamp(log2, 0, 4);
    CTX.fillStyle = css(COLOURS[shade(log2)], log2 < 0 ? 0.5 : 0.9);
    CTX.fillRect(x - size, y - size, 2 * size, 2 * size);
  }
}

function drawFloor(travelled) {
  const far = STAGE.floor - 205;
  const ground = CTX.createLinearGradient(0, far - 20, 0, 700);
  ground.addColorStop(0, css(rgb(LOOK.surface), 0));
  ground.addColorStop(0.25, css(rgb(LOOK.surface), 1));
  ground.addColorStop(1, css(mixed(rgb(LOOK.surface), TEXT, DARK ? 0.05 : 0.06), 1));
  CTX.fillStyle = ground;
  CTX.fillRect(0, far - 20, STAGE.edge, 720 - far + 20);
  words("oldest", STAGE.left, 586, 12, { alpha: 0.55 });
  words("newest", STAGE.right, 586, 12, { align: "right", alpha: 0.55 });
  // The ground that the policy's robot runs over.
  CTX.strokeStyle = css(TEXT, 0.22);
  CTX.lineWidth = 1;
  CTX.beginPath();
  CTX.moveTo(STAGE.left, 690);
  CTX.lineTo(STAGE.right, 690);
  for (let k = 0; k < 17; k++) {
    const x = STAGE.left + ((((k * 50 - travelled * 60) % 850) + 850) % 850);
    if (x > STAGE.right) continue;
    CTX.moveTo(x, 690);
    CTX.lineTo(x - 8, 698);
  }
  CTX.stroke();
}

function drawCrowd(at, seconds) {
  const { row: rows, frames, radius, every } = TOLD.crowd;
  const speed = 0.25 / (TOLD.dt * every); // a quarter of real time
  const [standing, newest] = [[], recorded(at)];
  rows.forEach((row, k) => {
    if (row >= newest) return;
    const log2 = weight(at, row);
    if (log2 === null) return;
    const begun = TOLD.rows[at.fit] - TOLD.count[at.fit];
    const share = (row - begun) / Math.max(newest - begun, 1);
    standing.push({ k, log2, share, depth: (k * 7) % DEPTHS });
  });
  standing.sort((a, b) => b.depth - a.depth);
  for (const { k, log2, share, depth } of standing) {
    const size = SCALE * (1 - 0.13 * depth);
    const inset = 26 * depth;
    const x = STAGE.left + 30 + inset + share * (STAGE.right - STAGE.left - 60 - 2 * inset);
    const y = STAGE.floor - 62 * depth;
    const heavy = clamp(log2 / LOOK.octaves, -1, 1);
    const born = clamp((newest - rows[k]) / ((LAST - FIRST) * 0.01 + 1));
    const colour = COLOURS[shade(log2)];
    const ahead = (seconds * speed + k * 5) % (2 * frames - 2);
    const now = ahead < frames - 1 ? ahead : 2 * frames - 2 - ahead;
    const parts = pose({ ...TOLD.crowd, numbers: MOMENTS[k], shape: [frames, radius.length] }, now);
    CTX.fillStyle = css([0, 0, 0], DARK ? 0.35 : 0.13);
    CTX.beginPath();
    CTX.ellipse(x, y + 2, 0.3 * size * Math.min(TALL, 1), 0.05 * size, 0, 0, 7);
    CTX.fill();
    if (heavy > 0) {
      const strong = born * heavy ** 0.7;
      glow(colour, x, y - 0.5 * size * TALL, size * TALL * (0.55 + 0.4 * heavy), 0.75 * strong);
    }
    robot(parts, radius, {
      x, y, scale: size * (0.85 + 0.15 * born), colour,
      alpha: born * (heavy < 0 ? 0.95 + 0.6 * heavy : 1),
    });
  }
}

const MOMENTS = TOLD.crowd.row.map((_, k) => {
  const size = TOLD.crowd.frames * TOLD.crowd.radius.length * 6;
  return TOLD.crowd.numbers.subarray(k * size, (k + 1) * size);
});

function playedNow(step) {
  return TOLD.policy[TOLD.policy.findLastIndex((episode) => episode.step <= step)];
}

function drawPolicy(episode, seconds) {
  if (!episode) {
    words("the policy still acts at random: no evaluation is kept yet", STAGE.left, 716, 12, { alpha: 0.6 });
    return;
  }
  const frames = episode.shape[0];
  const now = (seconds / (TOLD.dt * episode.every)) * 0.5 % frames;
  robot(pose(episode, now), episode.radius, {
    x: 432, y: 690, scale: Math.min(116 / TALL, 200), colour: rgb(LOOK.learner),
    edge: css(mixed(rgb(LOOK.learner), [0, 0, 0], 0.45), 0.9),
  });
  const said = `the policy of step ${number(episode.step)}, return ${score(episode.return)}`;
  words(said, STAGE.left, 716, 13, { alpha: 0.85, bold: true });
}

function drawHead(at, step) {
  words(TOLD.title, STAGE.left, 46, 27, { bold: true });
  words("Which of its memories does the model look at while the policy learns?", STAGE.left, 72, 15, {
    alpha: 0.7,
  });
  words(`step ${number(step)}`, PANEL.right, 46, 27, { align: "right", bold: true });
  const ess = TOLD.ess[at.fit] + (TOLD.ess[at.next] - TOLD.ess[at.fit]) * at.share;
  const said = `effective sample ${number(100 * ess, 1)} % of the buffer`;
  words(said, PANEL.right, 72, 14, { align: "right", alpha: 0.7 });
}

function drawKey() {
  const [left, width, y] = [PANEL.left + 12, 140, 684];
  for (let i = 0; i < width; i++) {
    CTX.fillStyle = css(COLOURS[Math.round((255 * i) / width)]);
    CTX.fillRect(left + i, y, 1.5, 8);
  }
  const label = { align: "center", alpha: 0.7 };
  ["1/16", "1", "16"].forEach((text, i) => words(text, left + (i * width) / 2, y + 24, 11, label));
  words("times the uniform weight,", left + width + 16, y + 8, 11, { alpha: 0.7 });
  words("mean of a hundredth of the buffer", left + width + 16, y + 24, 11, { alpha: 0.7 });
}

function draw(seconds) {
  const share = clamp((seconds / TOLD.seconds - INTRO) / (1 - 2 * INTRO));
  const step = FIRST + share * (LAST - FIRST);
  const at = place(step);
  CTX.fillStyle = LOOK.background;
  CTX.fillRect(0, 0, CANVAS.width, CANVAS.height);
  const episode = playedNow(step);
  const frames = episode ? episode.shape[0] : 1;
  const now = episode ? Math.floor(((seconds / (TOLD.dt * episode.every)) * 0.5) % frames) : 0;
  CTX.save();
  CTX.beginPath();
  CTX.rect(0, 0, STAGE.edge, 720);
  CTX.clip(); // a pendulum's rail is longer than the stage
  drawFloor(episode ? episode.place[now] : 0);
  drawCrowd(at, seconds);
  drawPolicy(episode, seconds);
  CTX.restore();
  drawHead(at, step);
  drawMap(step);
  drawReturns(step);
  drawCloud(at);
  drawKey();
}

play(draw, TOLD.seconds, { begins: !navigator.webdriver });
