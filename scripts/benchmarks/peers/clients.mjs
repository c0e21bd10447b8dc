// The Colyseus clients of `bench.py peers`.
//
//     node clients.mjs ORDER     ORDER as JSON: {"port", "players", "light", "seed", "per_step"}
//
// Players predict with the SDK's reconciler, a frame every 8 ms. Light ones only send: they do not decode the state.
// `per_step` is the number of inputs that player 0 sends per step; all others send one.
// stdout: {"playing"} when all have joined; stdin: "log" prints the times of inputs and corrections.

import { Client } from "@colyseus/sdk";
import { Predict } from "@colyseus/sdk/predict";
import { STEP_MS, now, obey, say, step } from "./plane.mjs";

const order = JSON.parse(process.argv[2]);
const FRAME_MS = 8;
const JOINS_AT_ONCE = 10;

/** Returns a function that returns random numbers from 0 to 1 (mulberry32). */
function randomOf(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 4294967296;
  };
}

/** Walks all the time, and turns every 0.5 to 2 s. */
class Walk {
  constructor(seed) {
    this.random = randomOf(seed);
    this.steps = 0;
  }

  stage(data) {
    if (this.steps-- <= 0) {
      const angle = this.random() * 2 * Math.PI;
      this.steps = Math.round((500 + 1500 * this.random()) / STEP_MS);
      [data.mx, data.my] = [Math.round(127 * Math.cos(angle)), Math.round(127 * Math.sin(angle))];
    }
  }
}

class Bot {
  constructor(number, room, light) {
    this.name = `p${number}`;
    this.per_step = number === 0 ? order.per_step : 1;
    this.walk = new Walk(order.seed * 1000 + number);
    this.input = room.input();
    [this.sent, this.corrections, this.due] = [[], [], performance.now() + STEP_MS * this.walk.random()];
    if (light) {
      room.serializer.patch = () => {};
    } else {
      this.predict = Predict.get(room, { mode: "lerp" });
      this.predict.attachAll("players", { mode: "lerp", fields: ["x", "y"] });
      const mine = room.state.players.get(room.sessionId);
      const me = this.predict.reconciler(mine, {
        input: this.input,
        fields: ["x", "y"],
        step: (context, player, input) => step(player, input),
        warnOnDivergence: Infinity, // measures corrections without warnings
        onReconcile: () => me.lastCorrectionMag > 0 && this.corrections.push([now(), me.lastCorrectionMag]),
      });
    }
  }

  /** Returns the number of steps that are due: by the SDK, or by this clock, which drops what it missed. */
  steps(at) {
    if (this.predict) return this.predict.tick(at);
    if (at < this.due) return 0;
    this.due = Math.max(this.due + STEP_MS, at - STEP_MS);
    return 1;
  }

  frame(at) {
    for (let left = this.steps(at); left > 0; left--) {
      this.walk.stage(this.input.data);
      for (let again = this.per_step; again > 0; again--) {
        const number = this.input.send();
        if (this.predict) this.sent.push([number, now()]);
      }
    }
  }
}

/** Joins, waits for the own player, and returns its bot. */
async function join(number) {
  const room = await new Client(`ws://127.0.0.1:${order.port}`).joinOrCreate("plane", { name: `p${number}` });
  while (!room.state.players?.get(room.sessionId)) await new Promise((resolve) => room.onStateChange.once(resolve));
  return new Bot(number, room, number >= order.players);
}

const bots = [await join(0)];
setInterval(() => bots.forEach((bot) => bot.frame(performance.now())), FRAME_MS);
const wanted = order.players + order.light;
while (bots.length < wanted) {
  const more = Array.from({ length: Math.min(JOINS_AT_ONCE, wanted - bots.length) }, (_, k) => join(bots.length + k));
  bots.push(...(await Promise.all(more)));
}
say({ playing: bots.length });

const all = (value) => Object.fromEntries(bots.filter((bot) => bot.predict).map((bot) => [bot.name, value(bot)]));
obey({
  log: () => say({ sent: all((bot) => bot.sent), corrections: all((bot) => bot.corrections) }),
});
