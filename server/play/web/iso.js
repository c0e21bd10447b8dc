// The view of the blocks, from the south-east and above: projection, and a kept picture of each segment in sight.
//
//     screen x = (x + y) * HALF            north-west is up, north-east is right
//     screen y = (x - y) * QUARTER - z * RISE
//
// The faces of each block are kept beside its picture, so that a block can be drawn again over a figure behind it.

export const HALF = 24, QUARTER = 12, RISE = 26, SIDE = 32, FIRST_KIND = 7;
const AROUND = 6, WIDE = SIDE + 2 * AROUND; // blocks outside of a segment that cast shadows on it
const GRASS = 3, SOIL = 2; // kinds of shared/terrain.py
const PALETTE = {
  1: [132, 138, 150], 2: [156, 116, 80], 3: [128, 190, 92], 4: [206, 192, 168], 5: [124, 90, 62], 6: [78, 152, 88],
};
export const CHOICE = [
  [226, 122, 84], [240, 196, 96], [96, 172, 214], [154, 124, 206], [236, 236, 232], [84, 92, 110],
];
const SUN = Array.from({ length: 10 }, (_, i) => [-0.45, -0.21, 0.6].map(part => Math.round(part * (i + 1))));
const SHADE = { south: 0.84, east: 0.64 }, RIM = { south: 0.8, east: 0.64 };
const PICTURES_MAX = 24; // kept pictures of segments that are out of sight

export const project = (x, y, z) => [(x + y) * HALF, (x - y) * QUARTER - z * RISE];

// Returns the x and y of the position at a height that appears at a point of the plane.
export function unproject(px, py, z) {
  const a = px / HALF, b = (py + z * RISE) / QUARTER;
  return [(a + b) / 2, (a - b) / 2];
}

export const colourOf = kind => PALETTE[kind] ?? CHOICE[(((kind - FIRST_KIND) % CHOICE.length) + CHOICE.length) % CHOICE.length];

export function mixed(colour, share, other = [0, 0, 0]) {
  return colour.map((part, i) => Math.min(255, Math.max(0, Math.round(part * share + other[i] * (1 - share)))));
}

export const css = ([red, green, blue], alpha = 1) => `rgba(${red}, ${green}, ${blue}, ${alpha})`;

const depth = (x, y, z) => x - y + z;

export class Ground {
  constructor(blocks) {
    this._blocks = blocks; // has segment(x, y, z), block(x, y, z) and segments
    this._pictures = new Map();
    this._stale = new Set();
  }

  // Notes segments whose blocks have changed, and those around them, on which they cast shadows.
  changed(segments) {
    for (const [x, y, z] of segments)
      for (let i = -1; i <= 1; i++) for (let j = -1; j <= 1; j++) for (let k = -1; k <= 0; k++)
        this._stale.add([x + i, y + j, z + k].join());
  }

  // Draws all segments in sight. At most `most` of their pictures are drawn anew.
  draw(context, camera, width, height, scale, most) {
    const seen = [];
    for (const segment of this._blocks.segments) {
      const [left, top, right, bottom] = outline(segment);
      if (right > camera[0] && left < camera[0] + width && bottom > camera[1] && top < camera[1] + height) seen.push(segment);
    }
    seen.sort((a, b) => depth(...a) - depth(...b) || a[0] - b[0] || b[1] - a[1] || a[2] - b[2]);
    for (const segment of seen) {
      const name = segment.join();
      let picture = this._pictures.get(name);
      if ((!picture || picture.scale !== scale || this._stale.has(name)) && most > 0) {
        most -= 1;
        this._stale.delete(name);
        picture = this._drawn(segment, scale);
      }
      if (!picture) continue;
      this._pictures.delete(name);
      this._pictures.set(name, picture); // the last one is the one that was used last
      if (picture.canvas) context.drawImage(
        picture.canvas, picture.left - camera[0], picture.top - camera[1], picture.width, picture.height);
    }
    for (const name of this._pictures.keys()) {
      if (this._pictures.size <= seen.length + PICTURES_MAX) break;
      this._pictures.delete(name);
    }
  }

  // Draws again all faces in front of a box, within the present clip. Returns whether there are any.
  cover(context, camera, low, high) {
    const left = project(low[0], low[1], 0)[0], right = project(high[0], high[1], 0)[0];
    const top = project(low[0], high[1], high[2])[1], bottom = project(high[0], low[1], low[2])[1];
    let found = false;
    const [x0, y0, z0] = low.map(Math.floor);
    for (const [dx, dy, dz] of AHEAD) {
      const x = x0 + dx, y = y0 + dy, z = z0 + dz;
      if (x < high[0] && y + 1 > low[1] && z < high[2]) continue; // not in front of it
      const px = (x + y) * HALF, py = (x - y) * QUARTER - z * RISE;
      if (px + 2 * HALF <= left || px >= right || py + QUARTER <= top || py - QUARTER - RISE >= bottom) continue;
      if (!this._blocks.block(x, y, z)) continue;
      const picture = this._pictures.get(`${x >> 5},${y >> 5},${z >> 5}`);
      for (const face of picture?.faces.get((z & 31) << 10 | (y & 31) << 5 | (x & 31)) ?? []) {
        found = true;
        fill(context, face, -camera[0], -camera[1]);
      }
    }
    return found;
  }

  _drawn(segment, scale) {
    const kinds = this._surroundings(segment), faces = new Map(), cells = [];
    const at = (x, y, z) => kinds[(z * WIDE + y + AROUND) * WIDE + x + AROUND];
    for (let z = 0; z < SIDE; z++) for (let y = 0; y < SIDE; y++) for (let x = 0; x < SIDE; x++) {
      const kind = at(x, y, z);
      if (!kind) continue;
      const seen = [!at(x, y, z + 1), !at(x, y - 1, z), !at(x + 1, y, z)];
      if (!seen[0] && !seen[1] && !seen[2]) continue;
      const cell = [segment[0] * SIDE + x, segment[1] * SIDE + y, segment[2] * SIDE + z];
      faces.set(z << 10 | y << 5 | x, facesOf(cell, kind, seen, seen[0] ? light(at, x, y, z) : 1));
      cells.push([depth(x, y, z), x, y, z]);
    }
    const picture = { faces, scale, canvas: null };
    this._pictures.set(segment.join(), picture);
    if (!cells.length) return picture;
    let left = Infinity, top = Infinity, right = -Infinity, bottom = -Infinity;
    for (const each of faces.values()) for (const { points } of each) for (const [x, y] of points) {
      left = Math.min(left, x); right = Math.max(right, x); top = Math.min(top, y); bottom = Math.max(bottom, y);
    }
    [left, top] = [left - 1, top - 1];
    Object.assign(picture, { left, top, width: right - left + 1, height: bottom - top + 1 });
    picture.canvas = document.createElement("canvas");
    picture.canvas.width = Math.ceil(picture.width * scale);
    picture.canvas.height = Math.ceil(picture.height * scale);
    const context = picture.canvas.getContext("2d");
    context.scale(picture.canvas.width / picture.width, picture.canvas.height / picture.height);
    cells.sort((a, b) => a[0] - b[0] || a[1] - b[1] || b[2] - a[2] || a[3] - b[3]);
    for (const [, x, y, z] of cells) for (const face of faces.get(z << 10 | y << 5 | x)) fill(context, face, -left, -top);
    return picture;
  }

  _surroundings([i, j, k]) { // kinds of a segment and of AROUND more blocks at each side and above, [z, y, x]
    const kinds = new Uint8Array((SIDE + AROUND) * WIDE * WIDE);
    const span = part => [Math.max(0, part * SIDE + AROUND), Math.min(WIDE, (part + 1) * SIDE + AROUND)];
    for (let dz = 0; dz <= 1; dz++) for (let dy = -1; dy <= 1; dy++) for (let dx = -1; dx <= 1; dx++) {
      const from = this._blocks.segment(i + dx, j + dy, k + dz);
      if (!from) continue;
      const [x0, x1] = span(dx), [y0, y1] = span(dy), z1 = dz ? SIDE + AROUND : SIDE;
      for (let z = dz * SIDE; z < z1; z++) for (let y = y0; y < y1; y++) {
        const row = (z & 31) << 10 | ((y - AROUND) & 31) << 5;
        for (let x = x0; x < x1; x++) kinds[(z * WIDE + y) * WIDE + x] = from[row | ((x - AROUND) & 31)];
      }
    }
    return kinds;
  }
}

function outline([i, j, k]) { // left, top, right, bottom of a segment on the plane
  const [x, y, z] = [i * SIDE, j * SIDE, k * SIDE];
  return [
    project(x, y, 0)[0], project(x, y + SIDE, z + SIDE)[1], project(x + SIDE, y + SIDE, 0)[0], project(x + SIDE, y, z)[1],
  ];
}

function light(at, x, y, z) { // brightness of a block's top: lower in the sun's shadow and in corners
  const inside = (a, b, c) => c < SIDE + AROUND ? at(a, b, c) : 0;
  const dark = SUN.some(([i, j, k]) => inside(x + i, y + j, z + k));
  let near = 0;
  for (let i = -1; i <= 1; i++) for (let j = -1; j <= 1; j++) if ((i || j) && at(x + i, y + j, z + 1)) near++;
  return (0.86 + 0.34 * z / SIDE) * (dark ? 0.74 : 1) * (1 - 0.045 * near);
}

function facesOf([x, y, z], kind, [top, south, east], brightness) {
  const mix = Math.imul(x * 73 ^ y * 151 ^ z * 57, 2654435761 | 0) >>> 7;
  const grain = 1 + mix % 16 / 200 - 0.04, base = mixed(colourOf(kind), grain);
  const side = kind === GRASS ? mixed(colourOf(SOIL), grain) : base, faces = [];
  for (const [shows, a, b, way] of [[south, [x, y], [x + 1, y], "south"], [east, [x + 1, y], [x + 1, y + 1], "east"]]) {
    if (!shows) continue;
    faces.push(upright(a, b, z, z + 1, mixed(side, SHADE[way])));
    if (kind === GRASS) faces.push(upright(a, b, z + 0.7, z + 1, mixed(base, RIM[way])));
  }
  if (top) {
    const tone = brightness <= 1 ? mixed(base, brightness) : mixed(base, 2 - brightness, [255, 255, 220]);
    faces.push({ points: topOf([x, y, z]), colour: css(tone) });
  }
  return faces;
}

export function topOf([x, y, z]) {
  return [project(x, y, z + 1), project(x + 1, y, z + 1), project(x + 1, y + 1, z + 1), project(x, y + 1, z + 1)];
}

function upright(a, b, low, high, colour) {
  return { points: [project(...a, low), project(...b, low), project(...b, high), project(...a, high)], colour: css(colour) };
}

function fill(context, { points, colour }, dx, dy) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x + dx, y + dy) : context.moveTo(x + dx, y + dy)));
  context.closePath();
  context.fillStyle = context.strokeStyle = colour;
  context.lineWidth = 0.7; // closes the seams between faces
  context.fill();
  context.stroke();
}

// Offsets of the cells that may hide a box, the furthest first: those on the line of sight, and next to it.
const AHEAD = (() => {
  const cells = new Map();
  for (let step = 0; step < 7; step++)
    for (let i = -1; i <= 1; i++) for (let j = -1; j <= 1; j++) for (let k = -1; k <= 2; k++) {
      const cell = [step + i, j - step, step + k];
      cells.set(cell.join(), cell);
    }
  return [...cells.values()].sort((a, b) => depth(...a) - depth(...b) || a[0] - b[0] || b[1] - a[1] || a[2] - b[2]);
})();

// Returns the visible block at a point of the plane and the free cell in front of it; null if there is none.
export function targetOf(blocks, [px, py], height) {
  let before = null;
  for (let step = 0; step < 500; step++) {
    const z = height + 9 - step * 0.04, [x, y] = unproject(px, py, z), cell = [x, y, z].map(Math.floor);
    if (before && cell.every((part, k) => part === before[k])) continue;
    const kind = blocks.block(...cell);
    if (kind && before) return [cell, before];
    before = kind === undefined ? null : cell;
  }
  return null;
}
