// Two ghosts beside an episode as it was: the model by the weights as they are, and by brushed ones.

for (const one of TOLD.robots) one.numbers = unpacked(one.ends, "int16");
const STEPS = TOLD.robots[0].shape[0] - 1;
const TALL = Math.max(...pose(TOLD.robots[0], 0).filter((_, i) => i % 3 === 2), 0.4);
const SCALE = Math.min((0.62 * CANVAS.height) / TALL, 420);
const GROUND = 0.84 * CANVAS.height;

function draw(seconds) {
  const now = clamp((seconds * TOLD.speed) / TOLD.dt, 0, STEPS);
  CTX.fillStyle = LOOK.background;
  CTX.fillRect(0, 0, CANVAS.width, CANVAS.height);
  const place = TOLD.robots[0].place[Math.floor(now)];
  CTX.strokeStyle = css(TEXT, 0.3);
  CTX.lineWidth = 1.5;
  CTX.beginPath();
  CTX.moveTo(0, GROUND);
  CTX.lineTo(CANVAS.width, GROUND);
  for (let metre = Math.floor(place - 4); metre < place + 5; metre += 0.5) {
    const x = CANVAS.width / 2 + (metre - place) * SCALE;
    CTX.moveTo(x, GROUND);
    CTX.lineTo(x - 14, GROUND + 14);
  }
  CTX.stroke();
  for (const one of TOLD.robots) {
    const colour = rgb(one.colour);
    const x = CANVAS.width / 2 + (one.place[Math.floor(now)] - place) * SCALE + one.shift * SCALE;
    robot(pose(one, now), one.radius, {
      x, y: GROUND, scale: SCALE, colour, alpha: one.alpha,
    });
    CTX.font = `600 26px ${FONT}`;
    CTX.textAlign = "center";
    CTX.fillStyle = css(colour);
    CTX.fillText(one.name, CANVAS.width / 2 + one.shift * SCALE, GROUND + 62);
  }
  CTX.font = `400 22px ${FONT}`;
  CTX.textAlign = "right";
  CTX.fillStyle = css(TEXT, 0.75);
  CTX.fillText(`step ${Math.floor(now)} of ${STEPS}`, CANVAS.width - 24, 40);
}

play(draw, (STEPS * TOLD.dt) / TOLD.speed, { loops: true, begins: !navigator.webdriver });
