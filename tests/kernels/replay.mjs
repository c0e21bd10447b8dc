// Makes the calls of a tape (tape.py) again with a kernel in WebAssembly, and compares every byte after every call.
//
//     node replay.mjs KERNEL.wasm TAPE ARRAYS NAME:KINDS ...    the arrays of a world; the functions, in the tape's order
//
// Prints the number of calls; or which call differs, and exits with code 1.

import { readFileSync, openSync, readSync, closeSync } from "node:fs";

const [wasm, path, arraysOfAWorld, ...signatures] = process.argv.slice(2);
const functions = signatures.map((text) => text.split(":"));
const PAGE = 65536;

const memory = new WebAssembly.Memory({ initial: 64 });
const { exports } = new WebAssembly.Instance(new WebAssembly.Module(readFileSync(wasm)), { env: { memory } });
let bytes = new Uint8Array(memory.buffer);
let view = new DataView(memory.buffer);
const start = exports.__heap_base.value;

// The tape, read piece by piece.
const file = openSync(path);
let piece = Buffer.alloc(0);
let at = 0;
function need(count) {
  if (at + count <= piece.length) return true;
  const more = Buffer.allocUnsafe(Math.max(1 << 24, count));
  const got = readSync(file, more);
  piece = Buffer.concat([piece.subarray(at), more.subarray(0, got)]);
  at = 0;
  return count <= piece.length || (got > 0 && need(count));
}
function u32() {
  need(4);
  at += 4;
  return piece.readUInt32LE(at - 4);
}

let arrays, top, worlds;
function forget() {
  arrays = [];
  worlds = new Map();
  top = start;
}
function allocate(size) {
  const address = top;
  top = (top + size + 15) & ~15;
  if (top > memory.buffer.byteLength) {
    memory.grow(Math.ceil((top - memory.buffer.byteLength) / PAGE) + 256);
    bytes = new Uint8Array(memory.buffer);
    view = new DataView(memory.buffer);
  }
  bytes.fill(0, address, top);
  return address;
}
// The changes of an array: into what is expected of it and, from outside, into the memory.
function changes(outside) {
  const array = arrays[u32()];
  const count = u32();
  need(count * (4 + array.unit));
  const values = at + 4 * count;
  const index = (i) => piece.readUInt32LE(at + 4 * i);
  for (let i = 0, next; i < count; i = next) {
    for (next = i + 1; next < count && index(next) - index(i) === next - i; ) next++;
    const to = index(i) * array.unit;
    const from = values + i * array.unit;
    const end = values + next * array.unit;
    piece.copy(array.expected, to, from, end);
    if (outside) piece.copy(bytes, array.address + to, from, end);
  }
  at = values + count * array.unit;
}

let calls = 0;
function call() {
  need(1);
  const [name, kinds] = functions[piece[at++]];
  const touched = [];
  const block = [];
  const array = () => {
    const found = arrays[u32()];
    touched.push(found);
    return [found.address, 0, u32(), 0];
  };
  for (const kind of kinds) {
    if (kind === "n" || kind === "?") {
      block.push(u32(), u32());
    } else if (kind === "w") {
      const table = [];
      for (let i = 0; i < Number(arraysOfAWorld); i++) table.push(...array());
      const key = table.join();
      if (!worlds.has(key)) {
        worlds.set(key, allocate(4 * table.length));
        table.forEach((word, i) => view.setUint32(worlds.get(key) + 4 * i, word, true));
      }
      block.push(worlds.get(key), 0);
    } else {
      block.push(...array());
    }
  }
  const words = allocate(0);
  allocate(4 * block.length);
  block.forEach((word, i) => view.setUint32(words + 4 * i, word, true));
  const result = exports[name](words);
  top = words;
  calls++;
  need(6);
  const wanted = piece.readInt32LE(at);
  const changed = piece.readUInt16LE(at + 4);
  at += 6;
  for (let i = 0; i < changed; i++) changes(false);
  if (result !== wanted) return `call ${calls}, ${name}: gave ${result}, not ${wanted}`;
  for (const { address, expected } of touched) {
    const is = Buffer.from(memory.buffer, address, expected.length);
    if (!is.equals(expected)) {
      const byte = expected.findIndex((value, i) => value !== is[i]);
      return `call ${calls}, ${name}: array of ${expected.length} bytes differs at byte ${byte}`;
    }
  }
  return "";
}

forget();
let wrong = "";
while (!wrong && need(1)) {
  const op = String.fromCharCode(piece[at++]);
  if (op === "R") forget();
  else if (op === "A") {
    const [number, size] = [u32(), u32()];
    need(1);
    arrays[number] = { address: allocate(size), unit: piece[at++], expected: Buffer.alloc(size) };
  } else if (op === "W") changes(true);
  else if (op === "C") wrong = call();
  else wrong = `no such entry: ${op}`;
}
closeSync(file);
console.log(wrong || `${calls} calls`);
process.exitCode = wrong ? 1 : 0;
