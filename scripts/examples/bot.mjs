// A client in plain Node.js, written from docs/protocol.md alone: joins, walks in squares, and prints all positions.
//
//     npm ci && node bot.mjs ws://127.0.0.1:8765 [seconds]
//     npm ci && node bot.mjs "ws://127.0.0.1:8765/match?kind=arena" [seconds]
//
// It goes where the server sends it (`Go`), and reconnects to its world after a lost connection.
// Its timeline is ahead of the server. It has an input per tick, and sends those that change. It predicts with
// the kernel in WebAssembly: the world of the newest snapshot, stepped by the inputs after it. `predicted` in its output
// has its own states that it had predicted before the server sent them. SOVEREIGN_WEB is the folder of kernel.js
// (default: that of this checkout).

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { inflateSync } from "node:zlib";
import { decode, encode } from "@msgpack/msgpack";
import WebSocket from "ws";

const { SOVEREIGN_WEB: folder } = process.env;
const WEB = folder ? pathToFileURL(`${folder}/`) : new URL("../../client_sdk/web/", import.meta.url);
const { loadKernel } = await import(new URL("kernel.js", WEB));
const kernel = await loadKernel(readFileSync(new URL("../../shared/prebuilt/kernel.wasm", WEB)));

const [url = "ws://127.0.0.1:8765", seconds = 10] = process.argv.slice(2);
const HELLO = 1, INPUTS = 2, PING = 3, BYE = 4, HELD = 9, WELCOME = 17, SNAPSHOT = 18, TERRAIN = 19, PONG = 20, GOTO = 27, WAITING = 28;
const GOING_AWAY = 1001, TRIES = 3, HOPS = 8, NOTHING = new Uint8Array(0);
const STOP = [1, 2, 4], GO = [8, 16], FALL = 32, LAUNCH = 64, TOLD = 128; // events in an entity's turn
const NEW_MOVE = 8, NEW_BUTTONS = 16; // beside TOLD: the parts of its input that are new
const BLOCK = 2 ** 24, SIDE = 32 * BLOCK, SPEED = 2 ** 16, KEYFRAME = -1, USED = 0, REPEATED = 1, REFUSED = -32768;
const SQUARE = [[127, 0], [0, 127], [-127, 0], [0, -127]]; // east, north, west, south

const entities = new Map(); // id -> { tick, template, falls, at: [x, y, z], v: [x, y, z], move: [x, y, buttons] }, as on the wire
const said = new Map(); // id -> attributes
let me, scene, acked, sent, used = 0, pongs, margins, phase, lead; // of the world that it plays in
let world, coming, newer, inputs, fates, ahead, agreed; // the predicted world, terrain on its way, and what is predicted
let latest, told, due, changes; // the latest row, the newest tick that was sent, that of the next `Held`, ticks with rows: when late ones came
let socket, path = new URL(url).pathname + new URL(url).search, lobby = path, resume = NOTHING, timers = [];
let joined, going, leaving, ends, tries = 0, hops = 0, wait = 0; // `wait`: seconds to the next attempt; negative: none

const send = (...message) => socket.send(encode(message));
const now = () => performance.now() / 1000;
const rounded = value => Math.sign(value) * Math.round(Math.abs(value)); // halves away from zero
const home = at => at.map(part => Math.floor(part / SIDE)).join(); // a position's segment, as text
const ints = (bin, ...offsets) => offsets.map(offset => bin.readInt32LE(offset));
const reader = (bin = NOTHING, at = 0) => ({
  more: () => at < bin.length, i8: () => bin.readInt8(at++), u8: () => bin.readUInt8(at++), u24: () => bin.readUIntLE((at += 3) - 3, 3),
});
function* records(size, bin = []) { for (let at = 0; at < bin.length; at += size) yield bin.subarray(at, at + size); }

function connect() { // to a path of the server, or to the address of another one with a path
  [acked, sent, pongs, margins, lead, joined, going] = [-1, -1, [], [], undefined, false, false];
  entities.clear();
  said.clear();
  const { protocol, host } = new URL(url);
  socket = new WebSocket(path[0] === "/" ? `${protocol}//${host}${path}` : path, { perMessageDeflate: false });
  socket.on("open", () => send(HELLO, 4, {}, "node", "", resume));
  socket.on("message", data => {
    const [kind, ...fields] = decode(data); // each bin in it is a Buffer, as `data` is
    if (going) return;
    if (kind === WELCOME) welcome(...fields);
    else if (kind === PONG) pong(...fields);
    else if (kind === SNAPSHOT) snapshot(...fields);
    else if (kind === TERRAIN) terrain(...fields);
    else if (kind === GOTO) go(...fields);
    else if (kind === WAITING) console.error("waits for a world", JSON.stringify(decode(fields[0])));
    else if (kind === BYE) {
      if (joined) wait = fields[2];
      console.error(`the server says goodbye: ${fields[0]} ${fields[1]}`);
    }
  });
  socket.on("close", closed);
  socket.on("error", error => console.error(error.message)); // "close" follows
}

const name = place => place.split("?")[0].replace(/^\w+:\/\/[^/]*/, ""); // of a path, or of an address with a path

function go(to, code, seats, reason) {
  console.error(`goes to ${to.split("?")[0]}: ${reason}`);
  const same = !joined && resume.length && name(to) === name(path); // its world is at another server by now
  if (!joined && !same) lobby = path; // it asks there again if the world does not take it
  [path, resume, going] = [to, same ? resume : NOTHING, true];
  socket.close(1000);
}

function closed() {
  timers.forEach(clearInterval);
  timers = [];
  if (joined) tell();
  if (leaving) process.exit(0);
  if (going ? ++hops > HOPS : ++tries > TRIES || wait < 0 || (!resume.length && path === lobby)) process.exit(1);
  if (!going && !resume.length) path = lobby;
  if (!going && resume.length) path = tries % 2 ? path : name(path); // its server may be gone: the first one knows
  setTimeout(connect, going ? 0 : 1000 * (wait + 0.25 * 2 ** tries));
}

function leave() {
  leaving = true;
  if (socket.readyState === WebSocket.OPEN) send(BYE, GOING_AWAY, "", -1);
  else process.exit(0);
}

function welcome(version, tick, entity, rules, key) {
  [me, scene, resume, joined, tries, wait] = [entity, rules, key, true, 0, 0];
  [world, coming, newer, agreed] = [kernel.world(scene), [], [], []];
  [inputs, fates, ahead, changes, latest] = [new Map(), new Map(), new Map(), new Map(), ""];
  path = path.replace(/\?seat=.*/, ""); // the seat counts once
  for (let i = 0; i < 5; i++) timers.push(setTimeout(() => send(PING, now(), 0), 100 * i));
  timers.push(setInterval(() => { send(PING, now(), 0); tell(); hops = 0; }, 1000));
  ends ??= setTimeout(leave, 1000 * seconds);
}

function tell() {
  const places = Object.fromEntries([...entities].map(([id, { at }]) => [id, at.map(part => part / BLOCK)]));
  console.log(JSON.stringify({ tick: acked, me, name: said.get(me)?.name, used, places, predicted: agreed }));
  agreed = [];
}

function pong(at, tick) { // the server's time is tick_rate * now + phase; the quickest answers measure it best
  const { tick_rate } = scene, trip = now() - at;
  pongs = [...pongs, { trip, phase: tick - tick_rate * (at + trip / 2) }].slice(-15);
  const best = [...pongs].sort((a, b) => a.trip - b.trip).slice(0, Math.ceil(pongs.length / 3));
  phase = best.map(each => each.phase).sort((a, b) => a - b)[best.length >> 1];
  if (lead !== undefined || pongs.length < 5) return;
  lead = best[0].trip / 2 * tick_rate + 2;
  timers.push(setInterval(walk, 250 / tick_rate));
}

function walk() { // sends a row for each tick that our timeline has reached; jumps at each corner
  const tick = Math.floor(scene.tick_rate * now() + phase + lead), side = 2 * scene.tick_rate;
  if (tick - sent > 7) [sent, latest] = [tick - 1, ""]; // the first time, or after a pause
  if (tick <= sent) return;
  const row = [...SQUARE[Math.floor(tick / side) % 4], tick % side === 0];
  if (row.join() !== latest) {
    send(INPUTS, sent + 1, acked, Uint8Array.from(Array(tick - sent).fill(row).flat()));
    for (let each = sent + 1; each <= tick; each++) changes.set(each, 0);
    [latest, told, due] = [row.join(), tick, tick + 1];
  } else if (tick >= due) {
    send(HELD, tick - told, tick - acked);
    [told, due] = [tick, tick + 2];
  }
  while (sent < tick) inputs.set(++sent, row);
  if (acked >= 0) predict();
}

function predict() { // up to the newest input; notes the own state of each tick, and the snapshot that it is based on
  while (world.tick < sent && world.has(me)) {
    world.step(inputs.has(world.tick + 1) ? [[me, inputs.get(world.tick + 1)]] : []);
    ahead.set(world.tick, { base: acked, state: world.state(me) });
  }
}

function compare(tick) { // what was predicted for a tick, if the server used every input that led to it
  const { base, state } = ahead.get(tick) ?? {};
  const ticks = Array.from({ length: tick - base }, (_, k) => base + 1 + k);
  if (state && ticks.every(each => fates.get(each) === USED)) agreed.push([tick, ...state]);
  for (const map of [ahead, inputs, fates, changes]) for (const old of map.keys()) if (old <= tick - 64) map.delete(old);
}

function again(tick) { // predicts from a snapshot on
  world.reset(tick, [...entities].map(([id, { template, falls, at, v, move }]) =>
    [id, template, falls ? 1 : 0, ...at, ...v, ...move]));
  predict();
}

function terrain(x, y, z, offset, total, chunk) {
  coming.push(chunk);
  if (offset + chunk.length < total) return;
  world.load([x, y, z], inflateSync(Buffer.concat(coming)));
  for (const { segment, block, kind } of newer) if (segment === [x, y, z].join()) world.setBlock(...block, kind);
  [coming, newer] = [[], []];
  if (acked >= 0) again(acked);
}

function* turns(bytes) { // yields the id and the events of each turn; the rest of its bytes is for `turn`
  for (let id = 0; bytes.more();) {
    const head = bytes.u8();
    let gap = head & 63;
    for (let more = head & 64, factor = 64; more; factor *= 128) {
      const part = bytes.u8();
      [gap, more] = [gap + (part & 127) * factor, part & 128];
    }
    id += gap + 1;
    yield [id, head & 128 ? bytes.u8() : TOLD | NEW_MOVE];
  }
}

function stop(bytes, template, k) { // returns where an entity stopped along an axis, from the low corner of its segment
  const first = bytes.u8(), block = (first & 31) * BLOCK;
  if (first & 128) return block + bytes.u24();
  const { box_offset = [-0.3, -0.3, 0], box_size = [0.6, 0.6, 1.8] } = scene.templates[template];
  const from = rounded(box_offset[k] * BLOCK), to = from + rounded(box_size[k] * BLOCK);
  const place = block - (first & 32 ? Math.max(from, to) : Math.min(from, to)); // this side of its box is at the block
  return ((place % SIDE) + SIDE) % SIDE;
}

function turn(entity, events, bytes) { // returns the entity after a tick with these events
  const { tick, template, at } = entity, { walk_speed, jump_speed } = scene.templates[template];
  const { gravity, terminal_speed, tick_rate, integrator } = scene;
  const told = events & TOLD ? events : 0;
  const move = [...told & NEW_MOVE ? [bytes.i8(), bytes.i8()] : entity.move.slice(0, 2)];
  move.push(told & NEW_BUTTONS ? bytes.u8() : entity.move[2]);
  const v = entity.v.map((old, k) =>
    k < 2 && walk_speed && events & (TOLD | GO[k]) ? rounded(walk_speed * SPEED * move[k] / 127) : old);
  if (events & LAUNCH) v[2] = rounded(jump_speed * SPEED);
  let falls = entity.falls || events & (LAUNCH | FALL), before = v[2];
  if (falls) v[2] = Math.max(v[2] - rounded(gravity * SPEED / tick_rate), -rounded(terminal_speed * SPEED));
  if (integrator === "semi") before = v[2];
  const way = [2 * v[0], 2 * v[1], before + v[2]].map(sum => rounded(sum * 128 / tick_rate));
  const to = at.map((from, k) => events & STOP[k] ? Math.floor(from / SIDE) * SIDE + stop(bytes, template, k) : from + way[k]);
  if (events & STOP[2] && before + v[2] < 0) falls = 0;
  if (home(to) !== home(at)) return { ...entity, tick: tick + 1, move }; // a row has the new state
  return { tick: tick + 1, template, falls, at: to, v: v.map((speed, k) => events & STOP[k] ? 0 : speed), move };
}

function judge(newest, first, statuses, early) { // where a row was late, the one before was used, although the status may be USED
  [...records(2, early)].map(margin => margin.readInt16LE()).forEach((margin, i, { length }) => {
    const tick = newest + 1 - length + i;
    if (margin !== REFUSED && margin < 0 && changes.has(tick)) changes.set(tick, tick - margin * scene.tick_rate / 8192);
  });
  statuses.forEach((fate, i) => {
    const tick = first + i, change = Math.max(...[...changes.keys()].filter(each => each <= tick));
    fates.set(tick, change > newest || changes.get(change) > tick ? REPEATED : fate);
  });
}

function snapshot(tick, newest, early, first, statuses, verdicts, drops, ...parts) {
  const told = new Map(), left = new Set(); // told: entities with a row; left: "segment", or "segment:entity"
  for (const drop of records(12, drops)) left.add(ints(drop, 0, 4, 8).join());
  for (const [x, y, z, ago, packed, rows, gone] of parts) {
    const segment = [x, y, z], bytes = reader(packed);
    for (const [id, events] of turns(bytes)) entities.set(id, turn(entities.get(id), events, bytes));
    if (ago === KEYFRAME) left.add(segment.join());
    for (const id of records(4, gone)) left.add(`${segment}:${id.readUInt32LE()}`);
    for (const row of records(33, rows)) told.set(row.readUInt32LE(), {
      tick, template: row[4], falls: row[5] & 1, at: ints(row, 6, 10, 14).map((part, k) => segment[k] * SIDE + part),
      v: ints(row, 18, 22, 26), move: [row.readInt8(30), row.readInt8(31), row[32]],
    });
  }
  for (let [id, entity] of entities) { // all others continue without an event
    while (entity.tick < tick) entity = turn(entity, 0);
    entities.set(id, entity);
    if (left.has(home(entity.at)) || left.has(`${home(entity.at)}:${id}`)) entities.delete(id);
  }
  for (const [id, entity] of told) entities.set(id, entity);
  for (const [, , , , , , , , , attributes = []] of parts)
    for (let i = 0; i < attributes.length; i += 2) said.set(attributes[i], attributes[i + 1]);
  acked = tick;
  judge(newest, first, statuses, early);
  for (const [x, y, z, , , , , , edits] of parts)
    for (const edit of records(3, edits)) {
      const at = edit.readUInt16LE(), block = [x * 32 + (at & 31), y * 32 + (at >> 5 & 31), z * 32 + (at >> 10)];
      if (coming.length) newer.push({ segment: [x, y, z].join(), block, kind: edit[2] });
      if (world.loaded([x, y, z])) world.setBlock(...block, edit[2]);
    }
  for (const drop of records(12, drops)) world.unload(ints(drop, 0, 4, 8));
  if (entities.has(me)) compare(tick);
  again(tick);
  used += statuses.filter(fate => fate === USED).length;
  margins.push(...[...records(2, early)].map(margin => margin.readInt16LE()).filter(margin => margin !== REFUSED));
  margins = margins.slice(-2 * scene.tick_rate);
  if (margins.length) lead += Math.max(-0.02, Math.min(0.5 - Math.min(...margins) * scene.tick_rate / 8192, 0.1)); // half a tick to spare
}

connect();
