// The drawing of entities: small round figures with a shadow, a face in the direction of movement, and a name.

import { HALF, QUARTER, css, mixed, project } from "./iso.js";

const UNIT = HALF / 20, WIDTH = 48, HEIGHT = 79, FEET = 67, HIGH = 1.8, FINE = 3;
const IT = [232, 64, 58], WHITE = [255, 255, 255], INK = [22, 28, 44], SHIELD = [120, 200, 255], OWN = [255, 146, 60];
const GREEN = [120, 230, 120], SHADOW = [20, 40, 20];
const TONES = [
  [66, 135, 245], [245, 190, 60], [160, 105, 225], [40, 178, 170], [245, 140, 190], [250, 250, 250],
  [70, 90, 130], [150, 215, 245], [120, 80, 60],
];
const PIPS_MAX = 10, FUEL_MAX = 96, BAR = 48, SMALL = 0.7, LOW = 1.2;
export { IT, OWN };

// The colours and headings of the figures in sight.
export class Cast {
  constructor() {
    this._tones = new Map();
    this._headings = new Map();
  }

  // Returns the figures of a view, with their state in the game.
  of(view, scene) {
    const templates = Object.fromEntries(scene.templates.map(each => [each.name, each]));
    const person = size(templates[scene.player ?? "player"]).join(), seen = new Set();
    const found = [view.me, ...view.others].filter(Boolean).map(each => {
      seen.add(each.entity);
      const template = templates[each.template], own = each === view.me, { attributes, fields } = each;
      const team = attributes.team ?? fields.team, it = each.template === "it";
      const tone = named(attributes.colour)
        ?? (Number.isInteger(team) ? TONES[team % TONES.length] : own ? OWN : this._tone(each.entity));
      const [vx, vy] = each.velocity;
      if (vx || vy) this._headings.set(each.entity, [vx, vy]);
      const walks = template.walk_speed > 0, sides = size(template);
      return {
        ...each, own, it, tone: it ? IT : tone, heading: this._headings.get(each.entity) ?? [1, -1], walks,
        safe: Number.isInteger(attributes.safe) && attributes.safe > view.tick, sides, low: lowest(template),
        ball: !walks && Math.max(...sides) < SMALL, car: walks && sides[2] < LOW,
        box: !walks && Math.max(...sides) >= SMALL && sides.join() !== person,
      };
    });
    for (const kept of [this._tones, this._headings]) for (const entity of kept.keys()) if (!seen.has(entity)) kept.delete(entity);
    return found;
  }

  _tone(entity) { // stays while it is in sight, and is unique while there are enough colours
    if (!this._tones.has(entity)) {
      const counts = TONES.map((_, i) => [...this._tones.values()].filter(tone => tone === i).length);
      this._tones.set(entity, counts.indexOf(Math.min(...counts)));
    }
    return TONES[this._tones.get(entity)];
  }
}

const size = ({ box_size: sides = [0.6, 0.6, 1.8] }) => sides.map(Math.abs);
const lowest = ({ box_offset: offset = [-0.3, -0.3, 0], box_size: sides = [0.6, 0.6, 1.8] }) =>
  offset.map((part, k) => Math.min(part, part + sides[k]));

function named(value) { // the colour that an attribute names, like "#ff8800"
  const found = /^#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})$/i.exec(typeof value === "string" ? value : "");
  return found ? found.slice(1).map(part => parseInt(part, 16)) : null;
}

// Draws a figure, its shadow, and the blocks that cover it.
export function drawFigure(context, camera, figure, ground, blocks) {
  const [x, y, z] = figure.position, below = groundBelow(blocks, figure.position), { tone } = figure;
  const at = (...place) => { const [px, py] = project(...place); return [px - camera[0], py - camera[1]]; };
  if (figure.ball) {
    const radius = Math.max(figure.sides[0] * HALF * 0.7, 3), [px, py] = at(x, y, z);
    disc(context, at(x, y, below), 2 * radius, SHADOW, 0.43);
    circle(context, px, py, radius + 2, css(mixed(tone, 0.45)));
    circle(context, px, py, radius, css(tone));
    return;
  }
  if (figure.box) {
    drawBox(context, at, figure.position.map((part, k) => part + figure.low[k]), figure.sides, tone);
    return;
  }
  if (figure.own && !figure.it) disc(context, at(x, y, below), 56, WHITE, 0.92, 2);
  if (figure.safe) disc(context, at(x, y, below), 62, SHIELD, 0.92, 3);
  if (figure.it) {
    disc(context, at(x, y, below), 50, IT, 0.35);
    disc(context, at(x, y, below), 66, IT, 0.92, 4);
  }
  disc(context, at(x, y, below), 40 - Math.min(Math.floor(2 * (z - below)), 16), SHADOW, 0.43);
  if (figure.car) {
    drawCar(context, at, figure.position, figure.heading, tone);
    return;
  }
  const [px, py] = at(x, y, z), picture = sprite(tone, lookOf(figure.heading)), left = px - WIDTH / 2, top = py - FEET;
  context.save();
  context.globalAlpha = figure.walks ? 1 : 0.43;
  context.drawImage(picture, left, top, WIDTH, HEIGHT);
  context.globalAlpha = 1;
  context.beginPath();
  context.rect(left, top, WIDTH, HEIGHT);
  context.clip();
  if (ground.cover(context, camera, [x - 0.3, y - 0.3, z], [x + 0.3, y + 0.3, z + HIGH])) {
    context.globalAlpha = 0.27; // faintly visible through the blocks that cover it
    context.drawImage(picture, left, top, WIDTH, HEIGHT);
  }
  context.restore();
}

// Draws the name, and the fields "health" and "fuel" if there are any, over everything else.
export function drawName(context, camera, figure) {
  if (figure.ball || figure.box) return;
  const [px, py] = project(...figure.position).map((part, k) => part - camera[k]);
  const name = String(figure.attributes.name || `#${figure.entity}`);
  const text = figure.it ? (figure.own ? "You are it!" : `${name} is it!`) : name;
  const top = py - (figure.car ? 29 : FEET) - 20;
  plate(context, text, px, top, figure.it ? IT : figure.own ? [60, 130, 60] : INK);
  const health = Math.min(figure.fields.health ?? 0, PIPS_MAX);
  for (let pip = 0; pip < health; pip++) {
    circle(context, px + 10 * pip - 5 * (health - 1), top - 7, 5, css(INK));
    circle(context, px + 10 * pip - 5 * (health - 1), top - 7, 4, css(GREEN));
  }
  if (figure.own && figure.fields.fuel !== undefined) {
    context.fillStyle = css(INK);
    context.fillRect(px - BAR / 2 - 1, top - 9, BAR + 2, 7);
    context.fillStyle = css(GREEN);
    context.fillRect(px - BAR / 2, top - 8, Math.min(figure.fields.fuel, FUEL_MAX) * BAR / FUEL_MAX, 5);
  }
}

function plate(context, text, x, top, colour) {
  context.font = "600 13px system-ui, sans-serif";
  const width = context.measureText(text).width + 14;
  context.fillStyle = css(colour, 0.84);
  context.beginPath();
  context.roundRect(x - width / 2, top, width, 20, 10);
  context.fill();
  context.fillStyle = "#fff";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(text, x, top + 10.5);
}

const sprites = new Map();

function sprite(tone, looks) { // the picture of a figure; looks: direction on the screen in eighths, 0 is right, 2 is down
  const key = `${tone},${looks}`;
  if (sprites.has(key)) return sprites.get(key);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [WIDTH * FINE, HEIGHT * FINE];
  const context = canvas.getContext("2d"), x = WIDTH / 2, dark = css(mixed(tone, 0.45));
  context.scale(FINE, FINE);
  const body = (left, top, width, height, radius, colour) => {
    context.fillStyle = colour;
    context.beginPath();
    context.roundRect(left, top, width, height, radius);
    context.fill();
  };
  for (const [grown, colour] of [[2 * UNIT, dark], [0, css(tone)]]) {
    const half = 11 * UNIT + grown;
    body(x - half, FEET - 30 * UNIT - grown, 2 * half, 34 * UNIT + 2 * grown, half, colour);
  }
  body(x + 2 * UNIT, FEET - 30 * UNIT, 9 * UNIT, 34 * UNIT, 9 * UNIT, css(mixed(tone, 0.8)));
  const head = FEET - 36 * UNIT;
  circle(context, x, head, 13 * UNIT, dark);
  circle(context, x, head, 11 * UNIT, css(mixed(tone, 0.35, [255, 240, 222])));
  const [gx, gy] = [Math.cos(looks * Math.PI / 4), Math.sin(looks * Math.PI / 4)];
  if (gy > -0.6) { // otherwise the figure is seen from behind
    for (const eye of [-1, 1]) {
      const ex = x + gx * 6 * UNIT + eye * 4.2 * UNIT * (1 - 0.3 * Math.abs(gx)), ey = head + gy * 3 * UNIT + UNIT;
      circle(context, ex, ey, 2.9 * UNIT, "#fff");
      circle(context, ex + gx * 0.9 * UNIT, ey + gy * 0.7 * UNIT, 1.8 * UNIT, css(INK));
    }
  }
  sprites.set(key, canvas);
  return canvas;
}

function circle(context, x, y, radius, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

function disc(context, [x, y], width, colour, alpha, ring = 0) { // an ellipse on the ground
  context.beginPath();
  context.ellipse(x, y, (width - ring) / 2, (width - ring) / 2 * QUARTER / HALF, 0, 0, 2 * Math.PI);
  context.fillStyle = context.strokeStyle = css(colour, alpha);
  context.lineWidth = ring;
  if (ring) context.stroke();
  else context.fill();
}

function polygon(context, points, colour, rim) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.closePath();
  context.fillStyle = css(colour);
  context.fill();
  if (rim) {
    context.strokeStyle = css(rim);
    context.lineWidth = 1;
    context.stroke();
  }
}

function drawBox(context, at, [x0, y0, z0], sides, tone) { // the three visible faces of a box
  const [x1, y1, z1] = [x0 + sides[0], y0 + sides[1], z0 + sides[2]];
  for (const [share, corners] of [
    [1, [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]]],
    [0.8, [[x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1]]],
    [0.6, [[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]]],
  ]) polygon(context, corners.map(corner => at(...corner)), mixed(tone, share), mixed(tone, 0.4));
}

function drawCar(context, at, [x, y, z], heading, tone) { // two slabs and a window
  const length = Math.hypot(...heading), east = heading[0] / length, north = heading[1] / length;
  const slab = (back, front, half, up) => [[back, -half], [front, -half], [front, half], [back, half]]
    .map(([a, b]) => at(x + a * east - b * north, y + a * north + b * east, z + up));
  for (let k = 0; k < 5; k++) polygon(context, slab(-0.65, 0.65, 0.36, 0.1 + 0.06 * k), mixed(tone, 0.5));
  polygon(context, slab(-0.65, 0.65, 0.36, 0.4), tone);
  for (let k = 0; k < 4; k++) polygon(context, slab(-0.45, 0.25, 0.3, 0.45 + 0.06 * k), INK);
  polygon(context, slab(-0.42, 0.15, 0.28, 0.68), mixed(tone, 0.75, WHITE));
}

const lookOf = ([east, north]) => (Math.round(Math.atan2(east - north, east + north) * 4 / Math.PI) + 8) % 8;

function groundBelow(blocks, [x, y, z]) { // the height of the ground below a position
  const [i, j] = [Math.floor(x), Math.floor(y)];
  let k = Math.floor(z + 0.01);
  while (k > z - 12 && blocks.block(i, j, k - 1) === 0) k--;
  return Math.min(k, z);
}
