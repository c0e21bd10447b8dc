// A player in a plain canvas, seen from above. Arrows walk, space jumps.

import { connect } from "/play/sovereign.js";

const court = document.getElementById("court"), told = document.getElementById("told"), held = new Set(), BLOCK = 16;
addEventListener("keydown", ({ code }) => held.add(code));
addEventListener("keyup", ({ code }) => held.delete(code));

const client = await connect({
  name: "Ann",
  progress: (what, share) => { told.textContent = `loading ${what}: ${Math.round(100 * share)} %`; },
});
client.addEventListener("event", ({ detail: { type, reason = "" } }) => { told.textContent = `${type} ${reason}`; });

function draw() {
  const down = code => Number(held.has(code));
  const east = down("ArrowRight") - down("ArrowLeft"), north = down("ArrowUp") - down("ArrowDown");
  client.setInput(east, north, { buttons: { jump: held.has("Space") } });
  const { me, others } = client.view(), context = court.getContext("2d");
  context.fillStyle = "#80be5c";
  context.fillRect(0, 0, court.width, court.height);
  for (const { position: [x, y, z], attributes } of me ? [...others, me] : []) { // the own player is in the middle
    const at = [court.width / 2 + (x - me.position[0]) * BLOCK, court.height / 2 - (y - me.position[1]) * BLOCK];
    context.fillStyle = attributes.name === "Ann" ? "#ff923c" : "#4287f5";
    context.beginPath();
    context.arc(...at, Math.max(6 + z - me.position[2], 2), 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = "#000";
    context.fillText(attributes.name ?? "", at[0] + 9, at[1] + 4);
  }
  if (!client.closed) requestAnimationFrame(draw);
}
globalThis.client = client;
draw();
