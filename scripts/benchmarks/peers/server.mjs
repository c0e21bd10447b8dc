// The Colyseus server of `bench.py peers`.
//
//     node server.mjs WAY PORT     WAY: "next" takes one input per tick, "all" takes all that wait (for..of)
//
// stdout: a line when it listens; stdin: "mark" prints the counters, "log" prints the log of inputs.

import { createServer } from "node:http";
import { Room, Server } from "@colyseus/core";
import { WebSocketTransport } from "@colyseus/ws-transport";
import { Move, Plane, Player, RATE, STEP_MS, now, obey, say, step } from "./plane.mjs";

const [way, port] = [process.argv[2], Number(process.argv[3])];
const ticks = []; // the time at which each tick began
const logs = new Map(); // by session: the name, the inputs as [number, arrival, tick or -1], the place of the next one

class PlaneRoom extends Room {
  state = new Plane();
  patchRate = STEP_MS;
  inputs = this.defineInput(Move);

  onCreate() {
    this.setFixedTimestep(() => this.tick(), RATE);
  }

  onJoin(client, options) {
    const player = new Player();
    [player.name, player.x, player.y] = [options.name, 0, 0];
    this.state.players.set(client.sessionId, player);
    const log = { name: options.name, inputs: [], next: 0, walked: 0 };
    logs.set(client.sessionId, log);
    const buffer = client._inputBuffer;
    const push = buffer.push.bind(buffer);
    buffer.push = (...input) => {
      const before = buffer.consumedCount;
      push(...input);
      log.inputs.push([log.inputs.length + 1, now(), -1]);
      log.next += buffer.consumedCount - before; // an overflow has dropped the oldest
    };
  }

  onLeave(client) {
    this.state.players.delete(client.sessionId);
  }

  tick() {
    ticks.push(now());
    for (const [session, player] of this.state.players) {
      const [input, log] = [this.inputs.get(session), logs.get(session)];
      const [before, x, y] = [input.consumedCount, player.x, player.y];
      if (way === "next") {
        const one = input.next();
        if (one !== undefined) step(player, one);
      } else {
        for (const one of input) step(player, one);
      }
      for (let taken = input.consumedCount - before; taken > 0; taken--) {
        log.inputs[log.next++][2] = ticks.length - 1;
      }
      log.walked += Math.hypot(player.x - x, player.y - y);
    }
  }
}

const server = createServer();
const game = new Server({ transport: new WebSocketTransport({ server }), greet: false });
game.define("plane", PlaneRoom);
await game.listen(port, "127.0.0.1");
say({ port });

const all = (value) => Object.fromEntries([...logs.values()].map((log) => [log.name, value(log)]));
obey({
  mark() {
    const { user, system } = process.cpuUsage();
    say({
      now: now(),
      cpu_s: (user + system) / 1e6,
      ticks: ticks.length,
      rss_mb: process.memoryUsage.rss() / 1e6,
      in_view: logs.size, // everybody sees everybody
      walked: all((log) => log.walked),
    });
  },
  log: () => say({ first: 0, ticks, inputs: all((log) => log.inputs) }),
});
