/** The Python client in a worker. docs/client.md, "In a web page", shows how to use it. */

/** An entity, as it is drawn now. Positions in blocks (east, north, up), velocities in blocks per second. */
export interface Entity {
  entity: number;
  template: string;
  position: [x: number, y: number, z: number];
  velocity: [x: number, y: number, z: number];
  /** The direction (east, north) in which it aims, or else last walked. */
  facing: [east: number, north: number];
  attributes: Record<string, unknown>;
  /** The fields of its behaviour. */
  fields: Record<string, number>;
}

export interface View {
  /** The tick of the own entity, and the one at which the others are drawn. */
  tick: number;
  seen?: number;
  /** The own entity as predicted; null before the client has joined. */
  me: Entity | null;
  others: Entity[];
  state: "joining" | "playing" | "reconnecting" | "closed";
}

/** An event of the client: its type and fields are those of `client_sdk.events`. */
export interface GameEvent {
  type: string;
  [field: string]: unknown;
}

export interface Options {
  /** Address of the server and the world (default: the page's server, and the world in `?at=`). */
  url?: string;
  /** Address of what to load (default: /play/game.json). */
  description?: string;
  name?: string;
  token?: string;
  /** Name of a simulated connection, such as "wifi". */
  link?: string;
  /** Time for which a client tries to reconnect, in seconds. */
  patience_s?: number;
  /** Is called while the client loads: with what is loading, and the share of it, 0 to 1. */
  progress?: (what: string, share: number) => void;
}

/** Starts a client, and returns it as soon as it has joined the game. */
export function connect(options?: Options): Promise<Client>;

interface ClientEvents {
  /** An event of the client. */
  event: CustomEvent<GameEvent>;
  /** Segments whose blocks have arrived, changed or gone. */
  blocks: CustomEvent<[x: number, y: number, z: number][]>;
  /** A new view. */
  frame: CustomEvent<View>;
  /** The client has failed and does not go on. */
  failed: CustomEvent<{ reason: string }>;
}

export class Client extends EventTarget {
  private constructor();
  /** What the server says about the game. */
  readonly game: { title: string; keys: Record<string, string>; commands: Record<string, string[]> };
  /** The scene; null before the client has joined. */
  readonly scene: Record<string, unknown> | null;
  /** The values of the game for all players, and those for this one. */
  readonly shared: Record<string, unknown>;
  readonly private: Record<string, unknown>;
  readonly world: string;
  /** The statistics of the latest frame, by name: rtt_s, lead_s, corrections, frame_s, ... (`client_sdk.flat_view`). */
  readonly stats: Record<string, number>;
  /** The kernel's form, the times to load and to start (ms), and the worker's memory (bytes). */
  readonly started: { kernel?: string; loadMs?: number; startMs?: number; memory?: number };
  readonly closed: boolean;
  /** Latency to add to the real round trip, in seconds. */
  set latency(seconds: number);
  /** The name of a simulated connection; empty: none. */
  set link(name: string);
  /** The indices of the segments that are loaded. */
  readonly segments: [x: number, y: number, z: number][];
  /** Sets the input from now on. `x`, `y`: a direction (east, north) of length 0 to 1. */
  setInput(
    x: number,
    y: number,
    more?: { buttons?: Record<string, boolean>; aim?: [x: number, y: number, z: number] | null },
  ): void;
  /** Sends a command to the rules. Its result is the event `Answered`. */
  command(name: string, data?: unknown): void;
  /** Places a block, or removes it with kind 0. */
  edit(x: number, y: number, z: number, kind: number): void;
  /** Returns what to draw now, and asks for the next picture. Call it once per frame. */
  view(): View;
  /** The kinds of a segment's 32768 blocks, by z << 10 | y << 5 | x; undefined if it is not loaded. */
  segment(x: number, y: number, z: number): Uint8Array | undefined;
  /** The kind of a block; undefined if its segment is not loaded. */
  block(x: number, y: number, z: number): number | undefined;
  /** The diagnosis for developers. */
  verdict(): Promise<{ verdict: string; reason: string; advice: string; warnings: string[] }>;
  /** Leaves the game. */
  close(): void;
  addEventListener<K extends keyof ClientEvents>(type: K, listener: (event: ClientEvents[K]) => void): void;
}
