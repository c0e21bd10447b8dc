// The player's input: keyboard and mouse, touch, gamepad.

import { unproject, targetOf } from "./iso.js";

const WAYS = { // direction (east, north) of each key; north-west is up on the screen
  KeyW: [-1, 1], ArrowUp: [-1, 1], KeyS: [1, -1], ArrowDown: [1, -1],
  KeyD: [1, 1], ArrowRight: [1, 1], KeyA: [-1, -1], ArrowLeft: [-1, -1],
};
const CHOICE = ["left shift", "e", "q", "f", "r", "c", "x"]; // of buttons for which the rules name no key
const MOUSE = { "left mouse": "Mouse0", "middle mouse": "Mouse1", "right mouse": "Mouse2" };
const NAMED = {
  space: "Space", tab: "Tab", return: "Enter", backspace: "Backspace", "left shift": "ShiftLeft",
  "right shift": "ShiftRight", "left ctrl": "ControlLeft", "right ctrl": "ControlRight", "left alt": "AltLeft",
  "right alt": "AltRight", up: "ArrowUp", down: "ArrowDown", left: "ArrowLeft", right: "ArrowRight",
};
const PAD = [2, 7, 3, 1, 5, 4]; // buttons of a gamepad for the game's buttons besides jump (0), in turn
const DEAD = 0.2, STICK = 46, DRAG = 14, EYES = 1.1;

export function codeOf(name) { // the browser's code of a key that has pygame's name
  if (MOUSE[name] ?? NAMED[name]) return MOUSE[name] ?? NAMED[name];
  if (/^[a-z]$/.test(name)) return `Key${name.toUpperCase()}`;
  if (/^[0-9]$/.test(name)) return `Digit${name}`;
  return /^f[0-9]+$/.test(name) ? name.toUpperCase() : name;
}

// The keys of a scene's buttons, by button: those that the rules name, and a choice for the others.
export function keysOf(buttons, wanted) {
  const free = CHOICE.filter(key => !Object.values(wanted).includes(key)), names = {};
  for (const button of buttons) {
    const own = button === "jump" && !Object.values(wanted).includes("space") ? "space" : "";
    const name = wanted[button] || own || free.shift() || "";
    if (name) names[button] = name;
  }
  return names;
}

export class Controls {
  constructor(canvas, game, acts) {
    this._canvas = canvas;
    this._game = game;
    this._acts = acts; // functions: dig, place, choose, lag, diagnosis, chat, command
    this._held = new Set();
    this._pressed = new Set(); // since the input was read last
    this.mouse = null; // place of the mouse in the picture, in pixels
    this.zoom = 1; // of the picture
    this.typing = false;
    this.touched = false;
    this._stick = [0, 0];
    this._pads = new Map(); // button -> [x, y] of the drag since it is held
    addEventListener("keydown", event => this._key(event, true));
    addEventListener("keyup", event => this._key(event, false));
    addEventListener("blur", () => this._held.clear());
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("pointermove", event => this._point(event));
    canvas.addEventListener("pointerdown", event => this._down(event));
    addEventListener("pointerup", event => this._held.delete(`Mouse${event.button}`));
  }

  // Takes the scene: which keys and touch buttons there are.
  set scene(scene) {
    this._scene = scene;
    this.names = keysOf(scene.buttons ?? ["jump"], this._game.keys);
    this._codes = Object.fromEntries(Object.entries(this.names).map(([button, name]) => [codeOf(name), button]));
    this._commands = Object.fromEntries(Object.keys(this._game.commands)
      .filter(name => this._game.keys[name]).map(name => [codeOf(this._game.keys[name]), name]));
    this._buildPads();
  }

  // Returns direction, buttons and aim from now on.
  read(client, view, camera) {
    if (this.typing) return { x: 0, y: 0, buttons: {}, aim: null };
    const keys = Object.entries(WAYS).filter(([code]) => this._held.has(code)).map(([, way]) => way);
    let [x, y] = keys.reduce(([a, b], [c, d]) => [a + c, b + d], [0, 0]);
    const pad = this._gamepad(), stick = pad?.stick ?? this._stick;
    if (!x && !y) [x, y] = world(stick);
    const length = Math.hypot(x, y);
    if (length > 1) [x, y] = [x / length, y / length];
    const buttons = {}, dragged = [...this._pads.values()].find(([a, b]) => Math.hypot(a, b) > DRAG);
    for (const [code, button] of Object.entries(this._codes ?? {}))
      buttons[button] = this._held.has(code) || this._pressed.has(code) || this._pads.has(button) || (pad?.held.has(button) ?? false);
    this._pressed.clear();
    const aims = this._scene?.aim && Object.keys(buttons).some(button => button !== "jump" && buttons[button]);
    const way = pad?.aim ?? dragged ?? (this.touched ? stick : null);
    return { x, y, buttons, aim: aims ? this._aim(client, view, camera, way) : null };
  }

  // Returns the block under the mouse and the free cell in front of it; null if there is none within reach.
  pointed(client, view, camera, at = this.mouse) {
    if (!at || !view.me) return null;
    const found = targetOf(client, [at[0] + camera[0], at[1] + camera[1]], view.me.position[2]);
    const far = found && Math.hypot(...found[0].map((part, k) => part + 0.5 - view.me.position[k]));
    return found && far <= client.scene.reach ? found : null;
  }

  _aim(client, view, camera, way) {
    const { me } = view;
    if (!me) return null;
    if (way || !this.mouse) {
      const [east, north] = way && Math.hypot(...way) > DEAD ? world(way) : me.facing;
      return [east, north, 0];
    }
    const at = [this.mouse[0] + camera[0], this.mouse[1] + camera[1]], [x, y, z] = me.position;
    const found = targetOf(client, at, z);
    if (found) return [found[1][0] + 0.5 - x, found[1][1] + 0.5 - y, found[1][2] + EYES - (z + EYES)];
    const [east, north] = unproject(...at, z);
    return [east - x, north - y, 0];
  }

  _key(event, down) {
    if (event.target instanceof HTMLInputElement && event.target.type !== "range") return;
    const { code } = event, used = code in WAYS || code in (this._codes ?? {}) || code === "Space" || code === "Tab";
    if (used) event.preventDefault();
    if (!down) this._held.delete(code);
    if (!down || event.repeat || event.ctrlKey || event.metaKey) return;
    this._held.add(code);
    this._pressed.add(code);
    if (this._commands?.[code]) this._acts.command(this._commands[code]);
    else if (code === "BracketLeft" || code === "BracketRight") this._acts.lag(code === "BracketLeft" ? -50 : 50);
    else if (code === "F3") [event.preventDefault(), this._acts.diagnosis()];
    else if (code === "Enter") [event.preventDefault(), this._acts.chat()];
    else if (/^Digit[1-6]$/.test(code) && !(code in (this._codes ?? {}))) this._acts.choose(Number(code[5]) - 1);
  }

  _point({ clientX, clientY, pointerType }) {
    if (pointerType !== "touch") this.mouse = [clientX / this.zoom, clientY / this.zoom];
  }

  _down(event) {
    const { clientX, clientY, button, pointerType } = event, code = `Mouse${button}`;
    document.activeElement?.blur?.();
    if (pointerType === "touch") {
      this._touch();
      this._acts.tap([clientX, clientY]);
      return;
    }
    this._point(event);
    this._held.add(code);
    this._pressed.add(code);
    if (code in (this._codes ?? {})) return;
    if (button === 0) this._acts.dig([clientX, clientY]);
    if (button === 2) this._acts.place([clientX, clientY]);
  }

  // Shows the stick and the buttons, from the first touch on.
  _touch() {
    if (this.touched) return;
    this.touched = true;
    document.getElementById("touch").hidden = false;
  }

  _buildPads() {
    const stick = document.getElementById("stick"), knob = stick.firstElementChild, pads = document.getElementById("pads");
    const move = event => {
      const { left, top, width } = stick.getBoundingClientRect(), half = width / 2;
      let [x, y] = [(event.clientX - left - half) / STICK, (event.clientY - top - half) / STICK];
      const length = Math.max(1, Math.hypot(x, y));
      this._stick = [x / length, y / length];
      knob.style.transform = `translate(${this._stick[0] * STICK}px, ${this._stick[1] * STICK}px)`;
    };
    stick.onpointerdown = event => { stick.setPointerCapture(event.pointerId); this._touch(); move(event); };
    stick.onpointermove = event => { if (stick.hasPointerCapture(event.pointerId)) move(event); };
    stick.onpointerup = stick.onpointercancel = () => { this._stick = [0, 0]; knob.style.transform = ""; };
    pads.replaceChildren(...Object.keys(this.names).map(button => this._pad(button)));
    if (this._scene.reach > 0) pads.append(this._mode());
    if (matchMedia("(pointer: coarse)").matches) this._touch();
  }

  _pad(button) {
    const pad = Object.assign(document.createElement("button"), { type: "button", textContent: button });
    let start = [0, 0];
    pad.onpointerdown = event => {
      pad.setPointerCapture(event.pointerId);
      this._touch();
      start = [event.clientX, event.clientY];
      this._pads.set(button, [0, 0]);
      this._pressed.add(codeOf(this.names[button]));
      pad.classList.add("held");
    };
    pad.onpointermove = event => {
      if (this._pads.has(button)) this._pads.set(button, [event.clientX - start[0], event.clientY - start[1]]);
    };
    pad.onpointerup = pad.onpointercancel = () => { this._pads.delete(button); pad.classList.remove("held"); };
    return pad;
  }

  _mode() { // what a tap on a block does
    const modes = ["look", "dig", "place"], pad = Object.assign(document.createElement("button"), { type: "button" });
    this.mode = "look";
    pad.textContent = "look";
    pad.onclick = () => {
      this.mode = pad.textContent = modes[(modes.indexOf(this.mode) + 1) % modes.length];
      pad.setAttribute("aria-pressed", String(this.mode !== "look"));
    };
    return pad;
  }

  _gamepad() {
    const pad = navigator.getGamepads?.().find(each => each?.connected);
    if (!pad) return null;
    const [x = 0, y = 0, u = 0, v = 0] = pad.axes, others = Object.keys(this.names ?? {}).filter(name => name !== "jump");
    const held = new Set(others.filter((_, i) => pad.buttons[PAD[i]]?.pressed));
    if (pad.buttons[0]?.pressed) held.add("jump");
    const stick = Math.hypot(x, y) > DEAD ? [x, y] : [0, 0];
    return { stick, held, aim: Math.hypot(u, v) > DEAD ? [u, v] : stick };
  }
}

function world([right, down]) { // a direction on the screen as (east, north)
  return [(right + down) * Math.SQRT1_2, (right - down) * Math.SQRT1_2];
}
