// The same in 3D with three.js: the blocks around the player, and all entities as boxes. Arrows walk, space jumps.

import * as THREE from "three";
import { connect } from "/play/sovereign.js";

const told = document.getElementById("told"), held = new Set(), SIDE = 32;
const KINDS = [0x848a96, 0x9c7450, 0x80be5c, 0xcec0a8, 0x7c5a3e, 0x4e9858]; // colours of the kinds 1, 2, ...
const SIDES = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]];
addEventListener("keydown", ({ code }) => held.add(code));
addEventListener("keyup", ({ code }) => held.delete(code));

const renderer = new THREE.WebGLRenderer({ antialias: true });
document.body.append(renderer.domElement);
const world = new THREE.Scene(), camera = new THREE.PerspectiveCamera(60, 1, 0.1, 200);
world.background = new THREE.Color(0x7ab8e8);
world.add(new THREE.HemisphereLight(0xffffff, 0x668844, 2.5));
camera.up.set(0, 0, 1); // x is east, y is north, z is up, as in the game
const size = () => {
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
};
addEventListener("resize", size);
size();

const client = await connect({
  name: "Ann",
  progress: (what, share) => { told.textContent = `loading ${what}: ${Math.round(100 * share)} %`; },
});
told.textContent = "";

const cube = new THREE.BoxGeometry(1, 1, 1), segments = new Map(), boxes = new Map();

function build([i, j, k]) { // the blocks of a segment that have a free side
  const kinds = client.segment(i, j, k), at = [], name = [i, j, k].join(), ground = new THREE.MeshLambertMaterial();
  world.remove(segments.get(name));
  for (let block = 0; kinds && block < kinds.length; block++) {
    const [x, y, z] = [i * SIDE + (block & 31), j * SIDE + (block >> 5 & 31), k * SIDE + (block >> 10)];
    const free = SIDES.some(([a, b, c]) => !client.block(x + a, y + b, z + c));
    if (kinds[block] && free) at.push([x, y, z, kinds[block]]);
  }
  const mesh = new THREE.InstancedMesh(cube, ground, at.length), place = new THREE.Matrix4();
  at.forEach(([x, y, z, kind], n) => {
    mesh.setMatrixAt(n, place.setPosition(x + 0.5, y + 0.5, z + 0.5));
    mesh.setColorAt(n, new THREE.Color(KINDS[kind - 1] ?? 0xe27a54));
  });
  segments.set(name, mesh);
  world.add(mesh);
}

client.segments.forEach(build);
client.addEventListener("blocks", ({ detail }) => detail.forEach(build));

function show({ entity, template, position, attributes }) {
  const { box_size: [a, b, c] } = client.scene.templates.find(({ name }) => name === template);
  if (!boxes.has(entity)) {
    const color = attributes.name === "Ann" ? 0xff923c : 0x4287f5;
    boxes.set(entity, new THREE.Mesh(cube, new THREE.MeshLambertMaterial({ color })));
    world.add(boxes.get(entity));
  }
  const box = boxes.get(entity);
  box.scale.set(Math.abs(a), Math.abs(b), Math.abs(c));
  box.position.set(position[0], position[1], position[2] + Math.abs(c) / 2);
}

function draw() {
  const down = code => Number(held.has(code));
  const east = down("ArrowRight") - down("ArrowLeft"), north = down("ArrowUp") - down("ArrowDown");
  client.setInput(east, north, { buttons: { jump: held.has("Space") } });
  const { me, others } = client.view(), there = new Set([me, ...others].map(each => each?.entity));
  for (const [entity, box] of boxes) if (!there.has(entity)) [world.remove(box), boxes.delete(entity)];
  for (const each of me ? [me, ...others] : []) show(each);
  if (me) {
    const [x, y, z] = me.position;
    camera.position.set(x, y - 9, z + 7);
    camera.lookAt(x, y, z + 1);
  }
  renderer.render(world, camera);
  if (!client.closed) requestAnimationFrame(draw);
}
Object.assign(globalThis, { client, boxes, segments });
draw();
