// The ego car: one low-poly body lofted through cross-sections, and four wheels. Origin at the centre of gravity, x forward, z up.

import * as THREE from "/vendor/three/three.module.js";
import { LAYERS, layerOrder, paint } from "/ground.js";

const MODEL_LENGTH_M = 4.358; // heights below belong to a hatchback of this length
const FRONT_AXLE = 0.202; // shares of the length, from the front bumper
const REAR_AXLE = 0.81;
const WHEEL_RADIUS_M = 0.31;

const PAINT = 0x98a2ad;
const TRIM = 0x3a434d;
const GLASS = 0x0d1318;
const TAIL_DIM = 0x6e1016;
const TAIL_BRIGHT = 0xff2a2a;

// Cross-sections from the front bumper to the tail: share of the length, then sill, shoulder, belt line and roof edge as
// [share of the half width, height in m], then the height at the middle in m.
const SECTIONS = [
  [0.0, [0.6, 0.32], [0.68, 0.46], [0.64, 0.6], [0.48, 0.65], 0.66],
  [0.025, [0.8, 0.22], [0.87, 0.46], [0.82, 0.66], [0.6, 0.73], 0.75],
  [0.09, [0.92, 0.18], [0.97, 0.5], [0.9, 0.77], [0.66, 0.84], 0.86],
  [0.2, [0.95, 0.18], [1.0, 0.55], [0.93, 0.87], [0.71, 0.94], 0.96],
  [0.29, [0.95, 0.18], [1.0, 0.57], [0.93, 0.94], [0.73, 1.0], 1.03],
  [0.45, [0.95, 0.18], [1.0, 0.59], [0.92, 0.97], [0.66, 1.4], 1.44],
  [0.62, [0.95, 0.18], [1.0, 0.6], [0.92, 0.99], [0.66, 1.44], 1.48],
  [0.86, [0.95, 0.18], [0.99, 0.62], [0.9, 1.02], [0.62, 1.37], 1.41],
  [0.955, [0.92, 0.2], [0.96, 0.62], [0.88, 0.99], [0.66, 1.05], 1.07],
  [0.985, [0.88, 0.24], [0.93, 0.58], [0.85, 0.92], [0.64, 0.97], 0.98],
  [1.0, [0.78, 0.32], [0.85, 0.55], [0.78, 0.84], [0.58, 0.88], 0.89],
];
const SIDE_GLASS = [4, 5, 6, 7]; // sections behind which the strip from belt line to roof is glass
const TOP_GLASS = [4, 7]; // windscreen and rear window

function ring([share, ...outline], length, halfWidth, front, scale) {
  const middle = outline.pop();
  const x = front - share * length;
  const half = outline.map(([y, z]) => [x, y * halfWidth, z * scale]);
  return [...half, [x, 0, middle * scale], ...half.reverse().map(([px, py, pz]) => [px, -py, pz])];
}

function bodyGeometry(length, width, front) {
  const scale = length / MODEL_LENGTH_M;
  const rings = SECTIONS.map((section) => ring(section, length, width / 2, front, scale));
  const positions = [];
  const colours = [];
  const quad = (a, b, c, d, colour) => {
    positions.push(...a, ...c, ...b, ...a, ...d, ...c);
    const { r, g, b: blue } = new THREE.Color(colour);
    for (let k = 0; k < 6; k += 1) colours.push(r, g, blue);
  };
  for (let i = 0; i + 1 < rings.length; i += 1) {
    for (let k = 0; k < 8; k += 1) {
      const strip = k < 4 ? k : 7 - k; // 0 sill, 1 flank, 2 window, 3 roof; the same on both sides
      const isGlass = (strip === 2 && SIDE_GLASS.includes(i)) || (strip === 3 && TOP_GLASS.includes(i));
      quad(rings[i][k], rings[i][k + 1], rings[i + 1][k + 1], rings[i + 1][k], isGlass ? GLASS : PAINT);
    }
    quad(rings[i][8], rings[i][0], rings[i + 1][0], rings[i + 1][8], TRIM);
  }
  for (const [cap, order] of [[rings[0], 1], [rings.at(-1), -1]]) {
    for (let k = 0; k < 4; k += 1) {
      const edge = [cap[k], cap[8 - k], cap[7 - k], cap[k + 1]];
      quad(...(order > 0 ? edge : edge.reverse()), k === 0 ? TRIM : PAINT);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  geometry.computeVertexNormals();
  return geometry;
}

function box(size, at, material) {
  const mesh = new THREE.Mesh(new THREE.BoxGeometry(...size), material);
  mesh.position.set(...at);
  return mesh;
}

function wheel(radius, side) {
  const roll = new THREE.Group();
  const tyre = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, 0.21, 22), new THREE.MeshLambertMaterial({ color: 0x14181c }));
  const rim = new THREE.Mesh(new THREE.CylinderGeometry(radius * 0.68, radius * 0.68, 0.02, 18), new THREE.MeshLambertMaterial({ color: 0x2a3138 }));
  rim.position.y = side * 0.1;
  roll.add(tyre, rim);
  const spoke = new THREE.MeshLambertMaterial({ color: 0xb9c2cb });
  for (let k = 0; k < 5; k += 1) {
    const arm = new THREE.Group();
    arm.add(box([radius * 0.6, 0.02, radius * 0.15], [radius * 0.33, side * 0.112, 0], spoke));
    arm.rotation.y = (k * 2 * Math.PI) / 5;
    roll.add(arm);
  }
  return roll;
}

function shadow(length, width, front) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const context = canvas.getContext("2d");
  const gradient = context.createRadialGradient(32, 32, 8, 32, 32, 32);
  gradient.addColorStop(0, "rgba(0,0,0,0.8)");
  gradient.addColorStop(0.6, "rgba(0,0,0,0.6)");
  gradient.addColorStop(1, "rgba(0,0,0,0)");
  context.fillStyle = gradient;
  context.fillRect(0, 0, 64, 64);
  const material = paint(LAYERS.shadow, { map: new THREE.CanvasTexture(canvas), transparent: true, depthWrite: false });
  const mesh = new THREE.Mesh(new THREE.PlaneGeometry(length * 1.14, width * 1.42), material);
  mesh.position.set(front - length / 2, 0, 0);
  mesh.renderOrder = layerOrder(LAYERS.shadow, true);
  return mesh;
}

export class Car {
  constructor(length, width, front, steeringRatio) {
    this.steeringRatio = steeringRatio;
    this.group = new THREE.Group();
    this.radius = (WHEEL_RADIUS_M * length) / MODEL_LENGTH_M;
    const scale = length / MODEL_LENGTH_M;
    this.group.add(new THREE.Mesh(bodyGeometry(length, width, front), new THREE.MeshLambertMaterial({ vertexColors: true, flatShading: true })));
    this.group.add(shadow(length, width, front));

    this.tail = new THREE.MeshBasicMaterial({ color: TAIL_DIM });
    const head = new THREE.MeshBasicMaterial({ color: 0xe9f2ff });
    for (const side of [-1, 1]) {
      this.group.add(box([0.12, width * 0.2, 0.13 * scale], [front - 0.988 * length, side * width * 0.325, 0.79 * scale], this.tail));
      this.group.add(box([0.12, width * 0.17, 0.07 * scale], [front - 0.04 * length, side * width * 0.33, 0.655 * scale], head));
    }
    this.group.add(box([0.03, width * 0.25, 0.1 * scale], [front - length, 0, 0.68 * scale], new THREE.MeshBasicMaterial({ color: 0xc9ced4 })));
    this.addWheels(length, width, front);
  }

  addWheels(length, width, front) {
    const arch = new THREE.MeshBasicMaterial({ color: 0x07090b });
    this.steered = [];
    this.wheels = [];
    for (const share of [FRONT_AXLE, REAR_AXLE]) {
      for (const side of [-1, 1]) {
        const x = front - share * length;
        const well = new THREE.Mesh(new THREE.CylinderGeometry(this.radius * 1.15, this.radius * 1.15, 0.25, 24), arch);
        well.position.set(x, side * (width / 2 - 0.12), this.radius * 1.03);
        const steer = new THREE.Group();
        steer.position.set(x, side * (width / 2 - 0.095), this.radius);
        const roll = wheel(this.radius, side);
        steer.add(roll);
        this.group.add(well, steer);
        this.wheels.push(roll);
        if (share === FRONT_AXLE) this.steered.push(steer);
      }
    }
  }

  /** Put the car somewhere: pose {x, y, yaw}, speed [m/s], steering-wheel angle [rad], brake 0 to 1, time since last call [s]. */
  update(pose, speed, steeringWheel, brake, dt) {
    this.group.position.set(pose.x, pose.y, 0);
    this.group.rotation.z = pose.yaw;
    for (const steer of this.steered) steer.rotation.z = steeringWheel / this.steeringRatio;
    for (const roll of this.wheels) roll.rotation.y += (speed * dt) / this.radius;
    this.tail.color.set(brake > 0.02 ? TAIL_BRIGHT : TAIL_DIM);
  }
}
