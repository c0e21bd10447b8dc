// The Python client in a worker: `connect`, then `setInput`, `command`, `view()` and events.
//
//     import { connect } from "/play/sovereign.js";
//     const client = await connect({ name: "Ann", progress: (what, share) => bar(what, share) });
//     client.addEventListener("event", ({ detail }) => console.log(detail.type));
//     function draw() {
//       client.setInput(1, 0, { buttons: { jump: true } });
//       const { me, others } = client.view();      // what to draw now; asks for the next picture
//       requestAnimationFrame(draw);
//     }
//
// The page has to come from the server that it plays on. `sovereign.d.ts` has the types.

const JUMP = "jump", REST = 20; // milliseconds after which the same input is sent again in any case
const RETRY_MS = 150;

// Starts a client, and returns it as soon as it has joined the game. Throws if it cannot.
export async function connect(options = {}) {
  const { url = ownUrl(), description = "/play/game.json", progress = () => {}, ...rest } = options;
  progress("the game", 0);
  const game = await described(description);
  const client = new Client(game);
  client._post("start", { game, url, options: rest });
  client.addEventListener("progress", ({ detail: { what, share } }) => progress(what, share));
  await client._joined;
  return client;
}

function ownUrl() { // the world is in the page's address: /play?at=/arena-1
  const at = new URLSearchParams(location.search).get("at") ?? "/";
  return `${location.protocol === "https:" ? "wss:" : "ws:"}//${location.host}${at.startsWith("/") ? at : `/${at}`}`;
}

async function described(address) {
  for (;;) {
    const answer = await fetch(address);
    if (answer.status === 202) await new Promise(done => setTimeout(done, RETRY_MS)); // the server prepares the files
    else if (answer.ok) return answer.json();
    else throw new Error(await answer.json().then(({ error }) => error, () => `${address}: status ${answer.status}`));
  }
}

export class Client extends EventTarget {
  constructor(game) {
    super();
    this.game = game; // title, keys, commands, behaviours
    this.scene = null;
    this.shared = {};
    this.private = {};
    this.world = "";
    this.stats = {};
    this.started = {}; // kernel, loadMs, startMs, memory
    this.closed = false;
    this._attributes = new Map();
    this._blocks = new Map();
    this._near = {}; // the segment that was looked up last
    this._view = { tick: 0, me: null, others: [], state: "joining" };
    this._asked = false;
    this._sent = "";
    this._sentAt = 0;
    this._answers = new Map();
    this._worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
    this._worker.onmessage = ({ data: { told, ...given } }) => this[`_${told}`](given);
    this._worker.onerror = event => this._failed({ reason: event.message ?? "the worker cannot be started" });
    this._joined = new Promise((done, failed) => { [this._done, this._fail] = [done, failed]; });
  }

  // Sets the input from now on: a direction (east, north) of length 0 to 1, the buttons that are held, and an aim.
  setInput(x, y, { buttons = {}, aim = null } = {}) {
    let bits = 0;
    for (const name of Object.keys(buttons)) if (buttons[name]) bits |= this._bit(name);
    const given = JSON.stringify([x, y, bits, aim]);
    if (given === this._sent && performance.now() - this._sentAt < REST) return;
    [this._sent, this._sentAt] = [given, performance.now()];
    this._post("input", { x, y, buttons: bits, aim });
  }

  // Sends a command to the rules of the game. Its result is the event `Answered`.
  command(name, data = null) {
    this._post("command", { name, data });
  }

  // Places a block, or removes it with kind 0.
  edit(x, y, z, kind) {
    this._post("edit", { x, y, z, kind });
  }

  // Adds latency, in seconds of the round trip, on top of the real one.
  set latency(seconds) {
    this._post("delay", { seconds });
  }

  // Simulates a connection by its name, such as "wifi"; empty: none.
  set link(name) {
    this._post("link", { name });
  }

  // Returns what to draw now, and asks the worker for the next picture. Call it once per frame.
  view() {
    if (!this._asked) {
      this._asked = true;
      this._post("frame");
    }
    return this._view;
  }

  // Returns the kinds of a segment's 32768 blocks, by z << 10 | y << 5 | x; undefined if it is not loaded.
  segment(x, y, z) {
    return this._blocks.get(`${x},${y},${z}`);
  }

  // Returns the kind of a block; undefined if its segment is not loaded.
  block(x, y, z) {
    const i = x >> 5, j = y >> 5, k = z >> 5, near = this._near;
    if (near.i !== i || near.j !== j || near.k !== k) this._near = { i, j, k, kinds: this.segment(i, j, k) };
    return this._near.kinds?.[(z & 31) << 10 | (y & 31) << 5 | (x & 31)];
  }

  // The indices of the segments that are loaded.
  get segments() {
    return [...this._blocks.keys()].map(name => name.split(",").map(Number));
  }

  // Returns the diagnosis for developers: verdict, reason, advice, warnings.
  verdict() {
    const number = this._answers.size + 1;
    this._post("verdict", { number });
    return new Promise(done => this._answers.set(number, done));
  }

  // Leaves the game.
  close() {
    if (!this.closed) this._post("close");
    this.closed = true;
  }

  _post(call, given = {}) {
    this._worker.postMessage({ call, ...given });
  }

  _bit(name) {
    const names = this.scene?.buttons ?? [JUMP];
    if (name === JUMP) return 1;
    const place = names.filter(each => each !== JUMP).indexOf(name);
    if (place < 0) throw new RangeError(`button = ${name}: no such button (there are ${names.join(", ")})`);
    return 2 << place;
  }

  _tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  _progress(given) {
    this._tell("progress", given);
  }

  _ready({ head, columns, states, ...started }) {
    this._head = Object.fromEntries(head.map((name, i) => [name, i]));
    this._columns = columns;
    this._states = states;
    this.started = started;
    this._tell("progress", { what: "the world", share: 1 });
    this.view();
  }

  _scene({ scene: { scene, fields } }) {
    this.scene = scene;
    this._fields = fields;
    this._blocks.clear();
    this._near = {};
    this._attributes.clear();
  }

  _events({ list }) {
    for (const event of list) {
      if (event.type === "Joined") this._done();
      if (event.type === "Left") {
        this._fail(new Error(event.reason || "the connection is over"));
        this.closed = true;
      }
      this._tell("event", event);
    }
  }

  _frame({ values, attributes = {}, blocks = [], game, frameMs }) {
    this._asked = false;
    const { _head: head } = this;
    for (const [entity, given] of Object.entries(attributes)) {
      if (given === null) this._attributes.delete(Number(entity));
      else this._attributes.set(Number(entity), given);
    }
    for (const { at, kinds } of blocks) this._blocks.set(at.join(), kinds);
    if (blocks.length) this._near = {};
    if (game) Object.assign(this, { shared: game.shared, private: game.private, world: game.world, code: game.code });
    this.stats = Object.fromEntries(Object.entries(head).map(([name, i]) => [name, values[i]]));
    this.stats.worker_ms = frameMs;
    this._view = this._drawn(values);
    if (blocks.length) this._tell("blocks", blocks.map(({ at }) => at));
    this._tell("frame", this._view);
  }

  _drawn(values) {
    const { rows, columns, me, tick, seen, state } = this.stats, start = Object.keys(this._head).length, all = [];
    for (let at = start, row = 0; row < rows; row++, at += columns) all.push(this._entity(values, at));
    const own = me ? all.shift() : null;
    return { tick, seen, me: own, others: all, state: this._states[state] };
  }

  _entity(values, at) {
    const [entity, number, x, y, z, vx, vy, vz, east, north] = values.subarray(at, at + this._columns.length);
    const fields = {}, names = this._fields[number] ?? [];
    names.forEach((name, i) => { fields[name] = values[at + this._columns.length + i]; });
    return {
      entity, template: this.scene.templates[number].name, position: [x, y, z], velocity: [vx, vy, vz],
      facing: [east, north], attributes: this._attributes.get(entity) ?? {}, fields,
    };
  }

  _answer({ number, value }) {
    this._answers.get(number)?.(value);
    this._answers.delete(number);
  }

  _failed({ reason }) {
    this._fail(new Error(reason));
    this._tell("failed", { reason });
  }
}
