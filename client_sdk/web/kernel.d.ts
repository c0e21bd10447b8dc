/** The physics in WebAssembly. docs/protocol.md, "If you predict", and docs/kernels.md describe it. */

/** id, template, flags (1: it falls), x, y, z, vx, vy, vz, move_x, move_y, buttons; whole numbers, as on the wire. */
export type State = [
  id: number, template: number, flags: number, x: number, y: number, z: number, vx: number, vy: number, vz: number,
  moveX: number, moveY: number, buttons: number,
];
/** move_x and move_y from -127 to 127, and the bits of the buttons. */
export type Input = [moveX: number, moveY: number, buttons: number];
/** The index of a segment. */
export type Segment = [x: number, y: number, z: number];
/** The scene of the message `Welcome`. */
export interface Scene {
  name?: string;
  tick_rate?: number;
  [field: string]: unknown;
}

/**
 * Loads kernel.wasm.
 * @param source its bytes, an answer of `fetch`, a URL, or a compiled module; a promise of one of these is awaited.
 */
export function loadKernel(
  source?: BufferSource | Response | URL | string | WebAssembly.Module | Promise<Response | BufferSource>,
): Promise<Kernel>;

export class Kernel {
  constructor(module: WebAssembly.Module);
  readonly module: WebAssembly.Module;
  /** Makes a world without blocks and entities. `entities` and `segments`: room to begin with; it grows by itself. */
  world(scene: Scene, room?: { entities?: number; segments?: number }): World;
}

/** The blocks and entities of a scene at one tick. */
export class World {
  private constructor();
  readonly scene: Scene;
  readonly memory: WebAssembly.Memory;
  /** The number of the latest step. */
  tick: number;
  /** Adds or replaces a segment. `kinds`: its 32768 blocks, by z << 10 | y << 5 | x. */
  load(segment: Segment, kinds: ArrayLike<number>): void;
  /** Removes a segment, which counts as solid from then on (below the scene's lowest segment as void). */
  unload(segment: Segment): void;
  /** Whether a segment is loaded. */
  loaded(segment: Segment): boolean;
  /** Changes a block of a loaded segment. */
  setBlock(x: number, y: number, z: number, kind: number): void;
  /** Replaces all entities by these states, which become the world at the end of `tick`. */
  reset(tick: number, states: Iterable<State>): void;
  /** Writes states as they are; an id that is not known becomes a new entity. */
  put(states: Iterable<State>): void;
  /** Removes an entity. */
  remove(id: number): void;
  /** Computes the next tick. An entity without an input goes on with its latest one. */
  step(inputs?: Iterable<[id: number, input: Input]>): void;
  has(id: number): boolean;
  /** The state of an entity. */
  state(id: number): State;
  /** The states of all entities, ascending by id. */
  states(): State[];
  /** The ids of the entities that were below the scene's lowest segment at the end of the latest step. */
  fell(): number[];
}

/** The numbers of a scene as the kernel takes them. */
export function sceneTables(scene: Scene): { templates: number[][]; walk: number[][]; parameters: number[] };
/** Rounds to the nearest whole number, halves away from zero. */
export function rounded(value: number): number;
