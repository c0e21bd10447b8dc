// Repeats a run of a world (test_loader.py) with client_sdk/web/kernel.js, and compares all states after every tick.
//
//     node loader.mjs RUN.json
//
// Prints the number of ticks; or which one differs, and exits with code 1.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { loadKernel, sceneTables } from "../../client_sdk/web/kernel.js";

const { scene, tables, segments, ops } = JSON.parse(readFileSync(process.argv[2]));
assert.deepEqual(sceneTables(scene), tables);
const kernel = await loadKernel(readFileSync(new URL("../../shared/prebuilt/kernel.wasm", import.meta.url)));
let world = kernel.world(scene, { entities: 1, segments: 1 });
const load = into => segments.forEach(([index, kinds]) => into.load(index, Buffer.from(kinds, "base64")));
load(world);
let ticks = 0;
for (const [op, ...given] of ops) {
  if (op === "put") world.put(given[0]);
  else if (op === "block") world.setBlock(...given);
  else if (op === "edited") load(world);
  else if (op === "again") { // a second world takes over where the first one is
    const other = kernel.world(scene);
    load(other);
    for (const block of given[0]) other.setBlock(...block);
    other.reset(world.tick, world.states());
    world = other;
  } else if (op === "step") {
    world.step(given[0]);
    assert.deepEqual(world.states(), given[1], `tick ${world.tick}`);
    assert.deepEqual(world.fell(), given[2], `tick ${world.tick}`);
    ticks++;
  }
}
assert.throws(() => world.state(1e9), /entity 1000000000: there is none/);
assert.throws(() => world.step([[1e9, [0, 0, 0]]]), /entity 1000000000: there is none/);
assert.throws(() => world.setBlock(1e6, 0, 0, 1), /its segment is not loaded/);
assert.throws(() => world.load([0, 0, 0], []), /kinds: 0 blocks, not 32768/);
assert.throws(() => world.put([[0]]), /id = 0: must be a whole number above 0/);
console.log(`${ticks} ticks`);
