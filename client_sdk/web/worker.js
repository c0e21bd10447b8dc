// The worker of sovereign.js: Python (Pyodide), the client's sources and the game's behaviours, and one client.
//
// Messages in:   {call: "start", game, url, options}, {call: "input", ...}, {call: "frame"}, {call: "command", ...} ...
// Messages out:  {told: "progress" | "ready" | "frame" | "failed", ...}

const GLUE = `
import json
from sovereign_netcode.client_sdk.browser import BrowserClient
from sovereign_netcode.client_sdk.flat_view import COLUMNS, HEAD, STATES
from sovereign_netcode.client_sdk.netsim.links import Link
from sovereign_netcode.shared import kernels

def connect(url, options, classes):
    import importlib
    behaviours = [getattr(importlib.import_module(module), name) for module, name in json.loads(classes)]
    return BrowserClient.connect(url, behaviours=behaviours, **json.loads(options))

def delay(client, seconds):
    client.link = Link(seconds / 2) if seconds else None

def about():
    return json.dumps({"head": HEAD, "columns": COLUMNS, "states": STATES, "kernel": kernels.get().form})
`;
const IDLE_MS = 50; // between two looks at the connection while no picture is drawn
const GAME_FRAMES = 6; // every sixth frame has the values of the game

let python, glue, client, timer, place, drawn = 0, frames = 0;

const tell = (told, more = {}, transfer = []) => postMessage({ told, ...more }, transfer);

onmessage = async ({ data: { call, ...given } }) => {
  try {
    await CALLS[call](given);
  } catch (error) {
    tell("failed", { reason: String(error.message ?? error) });
  }
};

const CALLS = {
  async start({ game, url, options }) {
    const began = performance.now();
    if (game.trouble) throw new Error(`this game cannot be played in a browser: ${game.trouble}`);
    const { python: base, sources, game: own } = game.bundles;
    const files = await fetched(game.bundles);
    const loaded = performance.now();
    tell("progress", { what: "Python", share: 1 });
    const { loadPyodide } = await import(`${base.at}pyodide.mjs`);
    const address = new URL(base.at, location.href).href;
    python = await loadPyodide({ indexURL: address, packages: [] });
    tell("progress", { what: "the game", share: 1 });
    const site = "/lib/site";
    for (const at of [`${base.at}packages.zip`, `${sources.at}sources.zip`, own && `${own.at}game.zip`]) {
      if (at) python.unpackArchive(files.get(at), "zip", { extractDir: site });
    }
    python.runPython(`import sys; sys.path.insert(0, ${JSON.stringify(site)})`);
    glue = python.globals;
    python.runPython(GLUE);
    const about = JSON.parse(glue.get("about")());
    place = Object.fromEntries(about.head.map((name, i) => [name, i]));
    client = glue.get("connect")(url, JSON.stringify(options), JSON.stringify(game.behaviours));
    const times = { loadMs: loaded - began, startMs: performance.now() - loaded };
    tell("ready", { ...about, ...times, memory: python._module.HEAPU8.length });
    pump();
  },
  input({ x, y, buttons, aim }) {
    const given = aim && python.toPy(aim);
    client?.press(x, y, buttons, given ?? undefined);
    given?.destroy();
  },
  frame() {
    if (!client) return;
    drawn = performance.now();
    frame();
  },
  command({ name, data }) {
    client.request(name, JSON.stringify(data ?? null));
  },
  edit({ x, y, z, kind }) {
    client.edit(x, y, z, kind);
  },
  delay({ seconds }) {
    glue.get("delay")(client, seconds);
  },
  link({ name }) {
    client.set_link(name);
  },
  verdict({ number }) {
    tell("answer", { number, value: JSON.parse(client.verdict()) });
  },
  close() {
    clearTimeout(timer);
    client?.close();
    events();
    close();
  },
};

// Fetches all files, so that they are in the browser's cache, and tells how far it is. Returns the archives, by address.
async function fetched(bundles) {
  const sizes = Object.assign({}, ...Object.values(bundles).map(({ files }) => files));
  const whole = Object.values(sizes).reduce((sum, size) => sum + size, 0), kept = new Map();
  let got = 0;
  const one = async address => {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${address}: status ${answer.status}`);
    const pieces = [], reader = answer.body.getReader(), keep = /(packages|sources|game)\.zip$/.test(address);
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      got += value.length;
      if (keep) pieces.push(value);
      tell("progress", { what: address.split("/").at(-1), share: got / whole });
    }
    if (keep) kept.set(address, new Uint8Array(await new Blob(pieces).arrayBuffer()));
  };
  await Promise.all(Object.keys(sizes).map(one));
  return kept;
}

// Keeps the connection and the prediction going while the page draws nothing: in a hidden tab, for example.
function pump() {
  timer = setTimeout(() => {
    if (performance.now() - drawn > 2 * IDLE_MS) {
      client.pump();
      events();
    }
    pump();
  }, IDLE_MS);
}

function events() {
  const list = JSON.parse(client.events());
  if (list.some(({ type }) => type === "Joined")) tell("scene", { scene: JSON.parse(client.describe()) });
  if (list.length) tell("events", { list });
}

function frame() {
  const began = performance.now(), count = client.frame(), values = copied(client.values, "f64").slice(0, count);
  if (values[place.events]) events();
  const more = {};
  if (values[place.attributes]) more.attributes = JSON.parse(client.attributes());
  if (values[place.blocks]) more.blocks = JSON.parse(client.blocks()).map(at => ({ at, kinds: copied(client.kinds(...at)) }));
  if (frames++ % GAME_FRAMES === 0) more.game = JSON.parse(client.game());
  const transfer = [values.buffer, ...(more.blocks ?? []).map(({ kinds }) => kinds.buffer)];
  tell("frame", { values, ...more, frameMs: performance.now() - began }, transfer);
}

function copied(buffer, type) { // the content of a buffer of Python
  const view = buffer.getBuffer(type), copy = view.data.slice();
  view.release();
  buffer.destroy();
  return copy;
}
