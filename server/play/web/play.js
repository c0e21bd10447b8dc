// The page: loads the client, draws its view in a canvas, and reads the player's input.

import { connect } from "./sovereign.js";
import { Controls } from "./controls.js";
import { Cast, drawFigure, drawName } from "./figures.js";
import { Hud, sentence } from "./hud.js";
import { CHOICE, FIRST_KIND, Ground, project, topOf } from "./iso.js";

const element = id => document.getElementById(id);
const SKY = ["#7ab8e8", "#def0fa"], SMALL = 700, SMALL_ZOOM = 0.72, HUD_MS = 200, FOLLOW = 6, SHARP_MAX = 2;
const canvas = element("picture"), context = canvas.getContext("2d", { alpha: false });
const asked = new URLSearchParams(location.search);

let zoom = 1, sharp = 1;

function fit() { // the canvas has the pixels of the screen
  zoom = Math.min(innerWidth, innerHeight) < SMALL && innerWidth < 1000 ? SMALL_ZOOM : 1;
  sharp = Math.min(devicePixelRatio || 1, SHARP_MAX);
  [canvas.width, canvas.height] = [Math.round(innerWidth * sharp), Math.round(innerHeight * sharp)];
  sky(context, innerWidth * sharp, innerHeight * sharp);
}

function sky(into, width, height) {
  const gradient = into.createLinearGradient(0, 0, 0, height);
  SKY.forEach((colour, i) => gradient.addColorStop(i, colour));
  into.fillStyle = gradient;
  into.fillRect(0, 0, width, height);
}

class Play {
  constructor(client) {
    this.client = client;
    this.ground = new Ground(client);
    this.cast = new Cast();
    this.hud = new Hud(client);
    this.camera = null;
    this.kind = FIRST_KIND;
    this.frames = []; // times of the last second's frames
    const edit = (at, choose) => {
      const found = this.controls.pointed(client, this.view, this.camera, at.map(part => part / zoom));
      if (found && client.scene.reach > 0) client.edit(...choose(found));
    };
    const dig = at => edit(at, found => [...found[0], 0]), place = at => edit(at, found => [...found[1], this.kind]);
    this.controls = new Controls(canvas, client.game, {
      dig, place,
      tap: at => ({ dig, place })[this.controls.mode]?.(at),
      choose: number => { this.kind = FIRST_KIND + number; },
      lag: step => this.lag(Math.min(Math.max(Number(element("lag").value) + step, 0), 1000)),
      diagnosis: () => this.hud.diagnose(),
      chat: () => this.chat(),
      command: name => client.command(name),
    });
    element("lag").oninput = () => this.lag(Number(element("lag").value));
    element("chat").onsubmit = event => { event.preventDefault(); this.chat(); };
    element("message").onkeydown = event => { if (event.key === "Escape") this.chat(""); };
    client.addEventListener("event", ({ detail }) => this.take(detail));
    client.addEventListener("blocks", ({ detail }) => this.ground.changed(detail));
    client.addEventListener("failed", ({ detail }) => fail(detail.reason));
    this.view = client.view();
    this.begin();
    if (asked.has("lag")) this.lag(Number(asked.get("lag")));
    this.at = this.shown = performance.now();
    requestAnimationFrame(now => this.frame(now));
  }

  begin() { // in a world, perhaps in another one than before
    const { client } = this, { scene, game } = client;
    [this.ground, this.camera] = [new Ground(client), null];
    this.controls.scene = scene;
    const more = scene.reach > 0 ? [["left / right mouse", "dig / place"], ["1-6", "colour"]] : [];
    if (this.speaks) more.push(["Enter", "say"]);
    this.hud.keys(this.controls.names, [...more, ["F3", "diagnosis"], ["[ ]", "latency"]]);
    document.title = `${game.title} - Sovereign Netcode`;
  }

  get speaks() {
    return (this.client.game.commands.say ?? []).includes("text");
  }

  take({ type, ...event }) {
    const { hud, client } = this;
    if (type === "Left") fail(event.reason || "The connection is over.");
    else if (type === "Happened") hud.say(sentence(event.name, event.data, this.view));
    else if (type === "Answered" && !event.done) hud.say(`rejected: ${event.verdict}`);
    else if (type === "Disconnected") hud.say(`connection lost (${event.reason}): reconnecting`);
    else if (type === "Resumed") hud.say(`reconnected after ${event.away_s.toFixed(1)} s`);
    else if (type === "Waiting") hud.say(`waiting for a world: ${event.position} of ${event.waiting} ...`);
    else if (type === "Moved") hud.say(event.reason || "to another world");
    else if (type === "Joined" && client.scene) this.begin();
    else if (type === "Diverged") hud.say(`ALARM: the predicted world differs from the server's: ${event.what}`);
  }

  lag(milliseconds) {
    element("lag").value = milliseconds;
    element("lagged").textContent = `${milliseconds} ms`;
    this.client.latency = milliseconds / 1000;
  }

  chat(text) {
    const form = element("chat"), field = element("message");
    if (form.hidden && text === undefined) {
      if (!this.speaks) return;
      form.hidden = false;
      field.focus();
    } else {
      const message = text ?? field.value.trim();
      if (message) this.client.command("say", { text: message });
      field.value = "";
      field.blur();
      form.hidden = true;
    }
    this.controls.typing = !form.hidden;
  }

  frame(now) {
    if (this.client.closed) return;
    requestAnimationFrame(later => this.frame(later));
    const { client, controls } = this, view = this.view = client.view();
    this.frames.push(now);
    while (this.frames[0] < now - 1000) this.frames.shift();
    this.hud.count(now);
    if (!view.me) return;
    const width = innerWidth / zoom, height = innerHeight / zoom, camera = this.follow(view.me.position, width, height, now);
    controls.zoom = zoom;
    const { x, y, buttons, aim } = controls.read(client, view, camera);
    client.setInput(x, y, { buttons, aim });
    const figures = this.cast.of(view, client.scene);
    this.draw(view, figures, camera, width, height);
    if (now - this.shown > HUD_MS) {
      this.shown = now;
      this.hud.show(figures, view);
    }
    this.at = now;
  }

  follow([x, y, z], width, height, now) { // the camera moves smoothly towards the player's own figure
    const [px, py] = project(x, y, z), wanted = [px - width / 2, py - height / 2 - 20];
    const share = this.camera ? 1 - Math.exp(-FOLLOW * Math.max(now - this.at, 0) / 1000) : 1;
    this.camera = (this.camera ?? wanted).map((old, k) => old + (wanted[k] - old) * share);
    return this.camera;
  }

  draw(view, figures, camera, width, height) {
    const { client, ground, controls } = this, scale = zoom * sharp;
    context.setTransform(scale, 0, 0, scale, 0, 0);
    sky(context, width, height);
    ground.draw(context, camera, width, height, scale, this.drawn ? 1 : 99);
    this.drawn = client.segments.length > 0;
    const pointed = controls.touched ? null : controls.pointed(client, view, camera);
    if (pointed && client.scene.reach > 0) {
      context.beginPath();
      topOf(pointed[0]).forEach(([x, y], i) => context[i ? "lineTo" : "moveTo"](x - camera[0], y - camera[1]));
      context.closePath();
      [context.strokeStyle, context.lineWidth] = ["#fff", 2];
      context.stroke();
    }
    const depth = ({ position: [x, y, z] }) => x - y + z;
    for (const figure of [...figures].sort((a, b) => depth(a) - depth(b))) drawFigure(context, camera, figure, ground, client);
    for (const figure of figures) drawName(context, camera, figure);
    if (client.scene.reach > 0) {
      context.fillStyle = `rgb(${CHOICE[(this.kind - FIRST_KIND) % CHOICE.length]})`;
      context.fillRect(14, height - 44, 30, 30);
    }
  }
}

function fail(reason) {
  element("start").hidden = false;
  element("join").hidden = true;
  element("loading").hidden = true;
  element("trouble").textContent = reason;
}

async function join(name) {
  element("join").hidden = true;
  element("loading").hidden = false;
  try {
    const client = await connect({
      name,
      progress: (what, share) => {
        element("what").textContent = `loading ${what} ...`;
        element("bar").value = share;
      },
    });
    element("start").hidden = true;
    globalThis.play = new Play(client); // for the console, and for tests
  } catch (error) {
    fail(error.message);
  }
}

addEventListener("resize", fit);
fit();
element("name").value = asked.get("name") ?? "";
element("join").addEventListener("submit", event => {
  event.preventDefault();
  join(element("name").value.trim() || "You");
});
if (asked.has("name")) join(asked.get("name") || "You");
