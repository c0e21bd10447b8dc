// A client in plain Node.js, from docs/protocol.md alone: joins, walks in squares, and tells where it is.
//
//     npm ci && node bot.mjs ws://127.0.0.1:8765 [seconds]
//
// It does not predict: it lives ahead of the server, sends an input per tick, and believes the snapshots.

import { inflateSync } from "node:zlib";
import { decode, encode } from "@msgpack/msgpack";
import WebSocket from "ws";

const [url = "ws://127.0.0.1:8765", seconds = "10"] = process.argv.slice(2);
const HELLO = 1, INPUTS = 2, PING = 3, BYE = 4, WELCOME = 17, SNAPSHOT = 18, TERRAIN = 19, PONG = 20;
const BLOCK = 2 ** 24, SIDE = 32 * BLOCK, SPEED = 2 ** 16, ROW_BYTES = 33, REFUSED = -32768, NONE = new Uint8Array(0);
const STOPS = [1, 2, 4], GO = [8, 16], FALL = 32, LAUNCH = 64, TOLD = 128; // what may happen in an entity's turn
const SQUARE = [[127, 0], [0, 127], [-127, 0], [0, -127]]; // east, north, west, south

const now = () => performance.now() / 1000;
const bytes = bin => new DataView(bin.buffer, bin.byteOffset, bin.byteLength);
const rounded = value => Math.sign(value) * Math.round(Math.abs(value));
const entities = new Map(); // id -> {segment, corner, template, at: steps from the corner, v, move, falling}
const names = new Map();
const ground = new Map(); // segment "x,y,z" -> 32768 kinds of blocks
let me = 0, rate = 0, scene, acked = -1, sent = -1, pieces = [];
let pongs = [], phase = 0, lead = 0, margins = [];
const seen = { snapshots: 0, terrain: 0, used: 0, missing: 0, path: 0 };

const socket = new WebSocket(url, { perMessageDeflate: false });
const send = (...message) => socket.send(encode(message));
const ping = () => send(PING, now(), 0);

socket.on("open", () => {
  send(HELLO, 2, {}, "node", "", new Uint8Array(0));
  for (let i = 0; i < 5; i++) setTimeout(ping, 100 * i);
  setInterval(ping, 1000);
  setInterval(() => console.log(`tick ${acked}: at ${place()?.map(part => part.toFixed(2))}, ${entities.size} in sight`), 1000);
  setTimeout(() => send(BYE, 1001, "", -1), 1000 * Number(seconds));
});
socket.on("message", data => {
  const [kind, ...fields] = decode(data);
  if (kind === WELCOME) { [, , me, scene] = fields; rate = scene.tick_rate; }
  else if (kind === PONG) pong(...fields);
  else if (kind === SNAPSHOT) snapshot(...fields);
  else if (kind === TERRAIN) terrain(...fields);
  else if (kind === BYE) console.error(`told to go: ${fields[0]} ${fields[1]}`);
});
socket.on("close", code => {
  console.log(JSON.stringify({ me, at: place(), below: below(), name: names.get(me), ...seen }));
  process.exit(code === 1001 ? 0 : 1);
});
socket.on("error", error => { console.error(error.message); process.exit(1); });

function pong(at, tick) { // the server's time: phase + rate * now, by the pings that stood in no queue
  pongs = [...pongs, { trip: now() - at, phase: tick - rate * (at + now()) / 2 }].slice(-15);
  const best = [...pongs].sort((a, b) => a.trip - b.trip).slice(0, Math.ceil(pongs.length / 3));
  phase = best.map(each => each.phase).sort((a, b) => a - b)[best.length >> 1];
  if (pongs.length !== 5) return;
  lead = best[0].trip / 2 * rate + 2;
  setInterval(act, 1000 / rate / 4);
}

function act() { // a row for each tick that our own clock, which is ahead, has reached
  const tick = Math.floor(rate * now() + phase + lead);
  if (sent < 0 || tick - sent > 16) sent = tick - 1;
  if (tick <= sent) return;
  const [x, y] = SQUARE[Math.floor(tick / rate / 2) % 4], row = [x & 255, y & 255, 0];
  const rows = Uint8Array.from({ length: 3 * (tick - sent) }, (_, i) => row[i % 3]);
  send(INPUTS, sent + 1, acked, rows);
  sent = tick;
}

function steer() { // the least margin of the last two seconds should be half a tick
  const least = Math.min(...margins);
  lead += Math.max(-0.02, Math.min(0.5 - least, 0.1));
}

function turn(entity, events = 0, tail = undefined) { // the physics, with what the world does to it told
  const { v, move, template } = entity, walk = scene.templates[template].walk_speed;
  let at = 0;
  if (events & TOLD) for (; at < 2; at++) move[at] = tail.getInt8(at);
  if (events & TOLD) at = 3; // the buttons
  for (const k of [0, 1]) if (walk && events & (TOLD | GO[k])) v[k] = rounded(walk * SPEED * move[k] / 127);
  if (events & LAUNCH) v[2] = rounded(scene.templates[template].jump_speed * SPEED);
  if (events & (LAUNCH | FALL)) entity.falling = true;
  let from = v[2];
  if (entity.falling && scene.gravity)
    v[2] = Math.max(v[2] - rounded(scene.gravity * SPEED / rate), -rounded(scene.terminal_speed * SPEED));
  if (scene.gravity && scene.integrator !== "mean") from = v[2];
  const sums = [2 * v[0], 2 * v[1], from + v[2]];
  const to = sums.map((sum, k) => entity.at[k] + Math.sign(sum) * Math.floor((Math.abs(sum) * 256 + rate) / (2 * rate)));
  for (const k of [0, 1, 2]) if (events & STOPS[k]) {
    to[k] = tail.getInt32(at, true);
    at += 4;
    if (k === 2 && sums[2] < 0) entity.falling = false;
    v[k] = 0;
  }
  if (to.every(part => part >= 0 && part < SIDE)) entity.at = to; // who leaves the segment is told of by a row
  return at;
}

function snapshot(tick, newest, early, first, fates, verdicts, drops, ...segments) {
  const before = place(), told = new Set(), turned = new Set();
  const parts = segments.map(([x, y, z, ago, heads = NONE, tails = NONE, rows = NONE, gone = NONE, , edits = NONE, attributes = []]) =>
    ({ x, y, z, key: `${x},${y},${z}`, whole: ago === -1, heads: bytes(heads), tails, rows: bytes(rows), gone: bytes(gone), edits: bytes(edits), attributes }));
  for (const { heads, tails } of parts) for (let at = 0, tail = 0; at < heads.byteLength; at += 5) {
    const id = heads.getUint32(at, true);
    tail += turn(entities.get(id), heads.getUint8(at + 4), bytes(tails.subarray(tail)));
    turned.add(id);
  }
  for (const [id, entity] of entities) for (let n = turned.has(id) ? 0 : tick - acked; n > 0; n--) turn(entity);
  for (const { rows } of parts) for (let at = 0; at < rows.byteLength; at += ROW_BYTES) told.add(rows.getUint32(at, true));
  const remove = (id, entity) => { if (!told.has(id)) { entities.delete(id); names.delete(id); } };
  const empty = new Set(parts.filter(part => part.whole).map(part => part.key));
  for (let at = 0; at < drops.length; at += 12) {
    const key = [0, 4, 8].map(offset => bytes(drops).getInt32(at + offset, true)).join();
    empty.add(key);
    ground.delete(key);
  }
  for (const [id, { segment }] of entities) if (empty.has(segment)) remove(id);
  for (const { key, gone } of parts) for (let at = 0; at < gone.byteLength; at += 4) {
    const id = gone.getUint32(at, true);
    if (entities.get(id)?.segment === key) remove(id);
  }
  for (const { x, y, z, key, rows, edits, attributes } of parts) {
    for (let at = 0; at < edits.byteLength; at += 3)
      for (const kinds of [ground.get(key), ...pieces.filter(piece => piece.key === key).map(piece => piece.edits)])
        if (kinds) kinds[edits.getUint16(at, true)] = edits.getUint8(at + 2);
    for (let at = 0; at < rows.byteLength; at += ROW_BYTES) {
      const [px, py, pz, ...v] = [6, 10, 14, 18, 22, 26].map(offset => rows.getInt32(at + offset, true));
      entities.set(rows.getUint32(at, true), {
        segment: key, corner: [32 * x, 32 * y, 32 * z], template: rows.getUint8(at + 4), at: [px, py, pz], v,
        move: [rows.getInt8(at + 30), rows.getInt8(at + 31)], falling: (rows.getUint8(at + 5) & 1) === 1,
      });
    }
    for (let i = 0; i < attributes.length; i += 2) names.set(attributes[i], attributes[i + 1].name ?? "somebody");
  }
  acked = tick;
  seen.snapshots += 1;
  for (const fate of fates) { seen.used += fate === 0; seen.missing += fate === 1 || fate === 2; }
  for (let at = 0; at < early.length; at += 2) margins.push(bytes(early).getInt16(at, true) / 256);
  margins = margins.filter(margin => margin !== REFUSED / 256).slice(-2 * rate);
  if (margins.length) steer();
  const after = place();
  if (before && after) seen.path += Math.hypot(after[0] - before[0], after[1] - before[1]);
}

function terrain(x, y, z, offset, total, chunk) {
  const key = `${x},${y},${z}`;
  if (offset === 0) pieces = [{ key, chunks: [], edits: {} }]; // edits that come until the last piece belong on top
  pieces[0].chunks.push(chunk);
  if (offset + chunk.length < total) return;
  ground.set(key, Object.assign(inflateSync(Buffer.concat(pieces[0].chunks)), pieces[0].edits));
  pieces = [];
  seen.terrain += 1;
}

function place() {
  const mine = entities.get(me);
  return mine?.at.map((part, axis) => mine.corner[axis] + part / BLOCK);
}

function below() { // the kind of the block under our feet
  if (!place()) return undefined;
  const [x, y, z] = place().map(Math.floor), height = z - 1;
  return ground.get([x >> 5, y >> 5, height >> 5].join())?.[(height & 31) << 10 | (y & 31) << 5 | (x & 31)];
}
