// The physics in WebAssembly: entities and blocks in, a step, entities out. The same bits as the server's.
//
//     import { loadKernel } from "./kernel.js";
//     const kernel = await loadKernel(bytes);        // the bytes of kernel.wasm, a fetch, a URL or a compiled module
//     const world = kernel.world(welcome.scene);     // the scene of the message `Welcome`
//     world.load([0, 0, 0], kinds);                  // a segment: 32768 kinds of blocks
//     world.reset(tick, states);                     // all entities at the end of a tick
//     world.step([[me, [127, 0, 1]]]);               // the next tick, with the inputs of some entities
//     world.state(me);
//
// A state is an array of 12 whole numbers: id, template, flags (1: it falls), x, y, z, vx, vy, vz, move_x, move_y,
// buttons. Positions are in units of 2^-24 block, velocities in 2^-16 block/s, as on the wire (docs/protocol.md).
// Nothing here knows about messages, clocks or behaviours.

const BLOCK = 2 ** 24, SPEED = 2 ** 16, SIDE = 32, BLOCKS = SIDE ** 3, PAGE = 2 ** 16, HIGH = 2 ** 32;
const COLUMNS = 16, STATES = 12, ID = 0, TEMPLATE = 1, FLAGS = 2, X = 3, CELL = 12, FALLING = 1; // of an entity
const TEMPLATE_COLUMNS = 18, MOVES = 255, MOVE_MAX = 127, PARAMETERS = 13, LENGTHS = 7, CANDIDATE = 7, RIDER = 2;
const N_FELL = 3, CELLS = 128, AT_ONCE = 2 ** 31, NOTHING = 2 ** 40, ENTITIES = 64, SEGMENTS = 16;
const BOX = [-0.3, -0.3, 0, 0.6, 0.6, 1.8]; // of a template without one

// The arrays of a world, in the order of `layout.Arrays`: bytes for a number of entities, segments and templates.
const ARRAYS = {
  entities: ({ entities }) => entities * COLUMNS * 8,
  templates: ({ templates }) => templates * TEMPLATE_COLUMNS * 8,
  walk: ({ templates }) => templates * MOVES * 8,
  parameters: () => PARAMETERS * 8,
  solid: ({ segments }) => segments * SIDE * SIDE * 4,
  segments: ({ segments }) => segments * 3 * 8,
  table: ({ table }) => table * 8,
  heads: ({ segments }) => segments * CELLS * 4,
  awake: ({ entities }) => (entities + 1) * 8,
  nextAwake: ({ entities }) => (entities + 1) * 8,
  woken: ({ entities }) => (entities + 1) * 8,
  later: ({ entities }) => (entities + 1) * 8,
  candidates: ({ entities }) => (entities + 1) * CANDIDATE * 8,
  changed: ({ entities }) => (entities + 1) * 8,
  fell: ({ entities }) => (entities + 1) * 8,
  lengths: () => LENGTHS * 8,
  near: () => 4 * 8,
  riders: ({ entities }) => (entities + 1) * RIDER * 8,
};
const SIZES = { solid: 4, heads: 4 }; // bytes of an item; 8 for all others

// Rounds to the nearest whole number, halves away from zero.
export function rounded(value) {
  const whole = Math.floor(Math.abs(value)), size = whole + (Math.abs(value) - whole >= 0.5 ? 1 : 0);
  return value >= 0 ? size : 0 - size;
}

// Loads the kernel.
export async function loadKernel(source = new URL("../../shared/prebuilt/kernel.wasm", import.meta.url)) {
  let given = await source;
  if (typeof given === "string" || given instanceof URL) given = await fetch(given);
  if (typeof Response !== "undefined" && given instanceof Response) {
    if (!given.ok) throw new Error(`kernel: ${given.url}: status ${given.status}`);
    given = await given.arrayBuffer();
  }
  return new Kernel(given instanceof WebAssembly.Module ? given : await WebAssembly.compile(given));
}

export class Kernel {
  constructor(module) {
    this.module = module;
  }

  // Makes a world without blocks and entities. `entities` and `segments`: room to begin with; it grows by itself.
  world(scene, { entities = ENTITIES, segments = SEGMENTS } = {}) {
    return new World(this.module, scene, entities, segments);
  }
}

export class World {
  constructor(module, scene, entities, segments) {
    this.scene = scene;
    this.tick = 0;
    this.memory = new WebAssembly.Memory({ initial: 4 });
    this._call = new WebAssembly.Instance(module, { env: { memory: this.memory } }).exports;
    this._passable = new Set((scene.kinds ?? []).filter(({ solid }) => solid === false).map(({ number }) => number));
    this._room = { entities: 0, segments: 0, templates: 0, table: 0 };
    this._top = this._call.__heap_base.value;
    this._table = this._allocate(16 * Object.keys(ARRAYS).length);
    this._words = this._allocate(8 * 16);
    this._at = {};
    this._loaded = new Map(); // "x,y,z" -> row of a segment; row 0 stands for all that are not loaded
    this._free = [];
    this._rows = new Map(); // id -> row of an entity
    this._given = { at: 0, bytes: 0 };
    const tables = sceneTables(scene);
    this._grow({ entities, segments: segments + 1, templates: tables.templates.length, table: 2 * (segments + 1) });
    tables.templates.forEach((row, i) => row.forEach((value, k) => this._set("templates", i * TEMPLATE_COLUMNS + k, value)));
    tables.walk.forEach((row, i) => row.forEach((value, k) => this._set("walk", i * MOVES + k, value)));
    tables.parameters.forEach((value, k) => this._set("parameters", k, value));
    this._clear();
  }

  // Adds or replaces a segment. `kinds`: its blocks, by z << 10 | y << 5 | x.
  load(segment, kinds) {
    if (kinds.length !== BLOCKS) throw new RangeError(`kinds: ${kinds.length} blocks, not ${BLOCKS}`);
    const name = segment.join();
    let row = this._loaded.get(name);
    if (row === undefined) {
      row = this._free.pop() ?? this._loaded.size + 1;
      if (row >= this._room.segments) this._grow({ ...this._room, segments: 2 * row, table: 4 * row });
      this._loaded.set(name, row);
      segment.forEach((part, k) => this._set("segments", 3 * row + k, part));
      this._index();
    }
    const words = new Uint32Array(this.memory.buffer, this._at.solid + row * SIDE * SIDE * 4, SIDE * SIDE);
    for (let line = 0; line < words.length; line++) {
      let word = 0;
      for (let x = 0; x < SIDE; x++) if (this._stops(kinds[line * SIDE + x])) word |= 1 << x;
      words[line] = word;
    }
    if (this._rows.size) this._call.relink_range(this._pack("w", 0, this._used));
    this._wakeIn(segment);
  }

  // Removes a segment, which counts as solid from then on (below the scene's lowest segment as void).
  unload(segment) {
    const row = this._loaded.get(segment.join());
    if (row === undefined) return;
    this._loaded.delete(segment.join());
    this._free.push(row);
    this._index();
    this._relinkAll();
    this._wakeIn(segment);
  }

  loaded(segment) {
    return this._loaded.has(segment.join());
  }

  // Changes a block of a loaded segment.
  setBlock(x, y, z, kind) {
    const row = this._loaded.get([x >> 5, y >> 5, z >> 5].join());
    if (row === undefined) throw new RangeError(`block ${x}, ${y}, ${z}: its segment is not loaded`);
    const words = new Uint32Array(this.memory.buffer, this._at.solid + row * SIDE * SIDE * 4, SIDE * SIDE);
    const line = (z & 31) << 5 | (y & 31), bit = 1 << (x & 31);
    words[line] = this._stops(kind) ? words[line] | bit : words[line] & ~bit;
    const corner = [x * BLOCK, y * BLOCK, (x + 1) * BLOCK, (y + 1) * BLOCK, (z + 1) * BLOCK];
    this._call.wake_on(this._pack("w", -1, ...corner));
  }

  // Replaces all entities by these states, which become the world at the end of `tick`.
  reset(tick, states) {
    this._clear();
    this.tick = tick;
    this.put(states);
  }

  // Writes states as they are; an id that is not known becomes a new entity.
  put(states) {
    const list = [...states];
    for (const [id] of list) {
      if (!(Number.isSafeInteger(id) && id > 0)) throw new RangeError(`id = ${id}: must be a whole number above 0`);
      if (this._rows.has(id)) continue;
      if (this._used === this._room.entities) this._grow({ ...this._room, entities: 2 * this._used });
      this._rows.set(id, this._used);
      for (let k = 0; k < COLUMNS; k++) this._set("entities", this._used * COLUMNS + k, k === CELL ? -1 : 0);
      this._used += 1;
    }
    const rows = this._give(8 * list.length * (1 + STATES)), data = rows + 8 * list.length;
    list.forEach((state, i) => {
      this._write(rows + 8 * i, this._rows.get(state[ID]));
      for (let k = 0; k < STATES; k++) this._write(data + 8 * (i * STATES + k), state[k]);
    });
    this._call.store(this._pack("w", [rows, list.length], [data, list.length * STATES], list.length, this.tick + 1));
  }

  // Removes an entity, and wakes what stood on it.
  remove(id) {
    this.reset(this.tick, this.states().filter(state => state[ID] !== id));
  }

  // Computes the next tick. `inputs`: pairs of an id and [move_x, move_y, buttons]; others go on with their latest one.
  step(inputs = []) {
    const list = [...inputs], data = this._give(8 * 4 * list.length);
    list.forEach(([id, input], i) => {
      if (!this._rows.has(id)) throw new RangeError(`entity ${id}: there is none`);
      [this._rows.get(id), ...input].forEach((value, k) => this._write(data + 8 * (4 * i + k), value));
    });
    this.tick += 1;
    this._call.step(this._pack("w", [data, 4 * list.length], list.length, this.tick));
  }

  has(id) {
    return this._rows.has(id);
  }

  // Returns the state of an entity.
  state(id) {
    const row = this._rows.get(id);
    if (row === undefined) throw new RangeError(`entity ${id}: there is none`);
    const state = Array.from({ length: STATES }, (_, k) => this._get("entities", row * COLUMNS + k));
    state[FLAGS] &= FALLING;
    return state;
  }

  // Returns the states of all entities, ascending by id.
  states() {
    return [...this._rows.keys()].sort((a, b) => a - b).map(id => this.state(id));
  }

  // Returns the ids of the entities that were below the scene's lowest segment at the end of the latest step.
  fell() {
    return Array.from({ length: this._get("lengths", N_FELL) }, (_, i) => this._get("fell", i));
  }

  _stops(kind) {
    return kind !== 0 && !this._passable.has(kind);
  }

  _clear() { // removes all entities
    const bytes = new Uint8Array(this.memory.buffer);
    bytes.fill(255, this._at.heads, this._at.heads + ARRAYS.heads(this._room)); // -1: an empty cell
    bytes.fill(0, this._at.lengths, this._at.lengths + ARRAYS.lengths());
    this._forget();
    this._rows.clear();
    this._used = 0;
  }

  _forget() { // the segment that was looked up last
    for (let k = 0; k < 4; k++) this._set("near", k, NOTHING);
  }

  _wakeIn(segment) {
    const low = segment.map(part => part * SIDE * BLOCK);
    this._call.wake_in(this._pack("w", ...low, ...low.map(part => part + SIDE * BLOCK)));
  }

  _relinkAll() { // after rows of segments have changed: cells are numbered by them
    const states = this.states();
    this._clear();
    if (states.length) this.put(states);
  }

  _index() { // the hash table of the loaded segments
    const mask = this._room.table - 1;
    for (let k = 0; k <= mask; k++) this._set("table", k, 0);
    for (const [name, row] of this._loaded) {
      const [x, y, z] = name.split(",").map(Number);
      let at = hash(x, y, z, mask);
      while (this._get("table", at)) at = (at + 1) & mask;
      this._set("table", at, row + 1);
    }
    this._forget();
  }

  _grow(room) { // moves all arrays that need more room
    room.table = 2 ** Math.ceil(Math.log2(room.table));
    const tableGrows = room.table !== this._room.table, before = this._room;
    Object.entries(ARRAYS).forEach(([name, bytes], i) => {
      const size = bytes(room), old = this._room.templates ? bytes(before) : 0;
      if (size > old) {
        const at = this._allocate(size), all = new Uint8Array(this.memory.buffer);
        if (name === "heads") all.fill(255, at, at + size);
        if (old) all.copyWithin(at, this._at[name], this._at[name] + old);
        this._at[name] = at;
      }
      this._write(this._table + 16 * i, this._at[name]);
      this._write(this._table + 16 * i + 8, size / (SIZES[name] ?? 8));
    });
    this._room = room;
    if (tableGrows) this._index();
  }

  _allocate(bytes) {
    const at = this._top;
    this._top = (at + bytes + 15) & ~15;
    const lacks = this._top - this.memory.buffer.byteLength;
    if (lacks > 0) this.memory.grow(Math.ceil(lacks / PAGE));
    return at;
  }

  _give(bytes) { // room for the arguments of a call
    if (bytes > this._given.bytes) this._given = { at: this._allocate(2 * bytes), bytes: 2 * bytes };
    return this._given.at;
  }

  _pack(...values) { // the arguments of a call in one block: "w" is the world, a pair an array
    let at = this._words;
    for (const value of values.flat()) {
      this._write(at, value === "w" ? this._table : value);
      at += 8;
    }
    return this._words;
  }

  get _view() {
    if (this._seen?.buffer !== this.memory.buffer) this._seen = new DataView(this.memory.buffer);
    return this._seen;
  }

  _write(at, value) { // a whole number below 2^53 as an int64
    this._view.setUint32(at, value, true);
    this._view.setInt32(at + 4, Math.floor(value / HIGH), true);
  }

  _set(name, i, value) {
    this._write(this._at[name] + 8 * i, value);
  }

  _get(name, i) {
    const at = this._at[name] + 8 * i;
    return this._view.getInt32(at + 4, true) * HIGH + this._view.getUint32(at, true);
  }
}

function hash(x, y, z, mask) { // as `find_segment` of shared/kernel.py, in the low bits
  return (Math.imul(x, 73856093) ^ Math.imul(y, 19349663) ^ Math.imul(z, 83492791)) & mask;
}

// The numbers of a scene as the kernel takes them (`Scene.kernel_tables`); each is rounded once.
export function sceneTables(scene) {
  const { tick_rate = 32, gravity = 18, terminal_speed = 16, integrator = "mean", entity_collision = true } = scene;
  const given = scene.templates ?? [{ name: "player", walk_speed: 3, jump_speed: 8 }];
  const templates = given.map(template => templateRow(template, gravity, tick_rate));
  const walk = given.map(({ walk_speed = 0 }) =>
    Array.from({ length: MOVES }, (_, i) => rounded(walk_speed * SPEED * (i - MOVE_MAX) / MOVE_MAX)));
  const most = of => Math.max(...templates.map(of));
  const parameters = [
    templates.some(row => row[9] > 0) ? 1 : 0,
    rounded(terminal_speed * SPEED),
    tick_rate,
    128 % tick_rate === 0 ? 128 / tick_rate : 0,
    integrator === "mean" ? 1 : 0,
    entity_collision ? 1 : 0,
    (scene.origin ?? [0, 0, 0])[2] * SIDE,
    ...[0, 1, 2].map(k => most(row => 0 - row[k])),
    ...[0, 1, 2].map(k => most(row => row[k] + row[3 + k])),
  ];
  return { templates, walk, parameters };
}

function templateRow(template, sceneGravity, rate) {
  const { box_offset = BOX.slice(0, 3), box_size = BOX.slice(3), walk_speed = 0, jump_speed = 0 } = template;
  const { solid = true, carries = false, gravity = sceneGravity, acceleration, friction, air_control } = template;
  const ends = box_offset.map((offset, k) => {
    const low = rounded(offset * BLOCK), high = low + rounded(box_size[k] * BLOCK);
    return [Math.min(low, high), Math.max(low, high)];
  });
  const perTick = value => rounded(value / rate * SPEED), weight = perTick(gravity), walks = walk_speed > 0;
  let rates = [weight, 0, 0, 0, 0, 0, 0, 0];
  if (friction !== undefined || (walks && acceleration !== undefined)) {
    const top = rounded(walk_speed * SPEED) + 2, share = air_control ?? (walks ? 1 : 0);
    rates = [weight, top * top];
    for (const part of [1, gravity > 0 ? share : 1]) {
      const faster = acceleration === undefined ? AT_ONCE : perTick(acceleration * part);
      const slower = friction === undefined ? faster : perTick(friction * part);
      rates.push(faster, slower, slower || faster);
    }
  }
  return [
    ...ends.map(([low]) => low), ...ends.map(([low, high]) => high - low), solid ? 1 : 0, walks ? 1 : 0,
    rounded(jump_speed * SPEED), ...rates, carries ? 1 : 0,
  ];
}
