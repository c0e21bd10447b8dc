// The game that Colyseus plays in `bench.py peers`: points on a plane. Server and clients share the step and the clock.

import { createInterface } from "node:readline";
import { schema, t } from "@colyseus/schema";

export const RATE = 32;
export const STEP_MS = 1000 / RATE;

/** A part of the direction is a whole number from -127 to 127, as in Sovereign Netcode. */
export const Move = schema({ mx: t.int8(), my: t.int8() }, "Move");
export const Player = schema({ name: t.string(), x: t.float32(), y: t.float32() }, "Player");
export const Plane = schema({ players: t.map(Player) }, "Plane");

/** Moves a player by one tick, at 2.98 units/s. The numbers are exact in float32, so that rounding corrects nothing. */
export function step(player, input) {
  player.x += (input.mx * 3) / 4096;
  player.y += (input.my * 3) / 4096;
}

/** Returns the seconds of the clock that Python's time.monotonic() reads on Linux. */
export const now = () => Number(process.hrtime.bigint()) / 1e9;

export const say = (what) => process.stdout.write(JSON.stringify(what) + "\n");

/** Calls a function of `commands` for each line of stdin. The process ends with the pipe. */
export function obey(commands) {
  const lines = createInterface({ input: process.stdin });
  lines.on("line", (line) => commands[line.trim()]());
  lines.on("close", () => process.exit(0));
}
