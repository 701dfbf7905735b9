// Flat and upright strips along polylines, cones, lettering: the pieces of which the world is made. SI units, z up.

import * as THREE from "/vendor/three/three.module.js";

const CONE_SPACING_M = 5;
const MARK_SPACING_M = 10;
const MARK_LENGTH_M = 0.7;
const CONE_BASE_M = 0.16; // half the side of a cone's foot: the foot touches the limit of the lane from outside

export const points = (x, y) => x.map((value, k) => [value, y[k]]);

function normalAt(line, k) {
  const [a, b] = [line[Math.max(k - 1, 0)], line[Math.min(k + 1, line.length - 1)]];
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
  return [-(b[1] - a[1]) / length, (b[0] - a[0]) / length];
}

/** A polyline moved to its left [m], and lengthened at both ends [m]. */
export function beside(line, left, extension = 0) {
  const moved = line.map(([x, y], k) => {
    const [nx, ny] = normalAt(line, k);
    return [x + left * nx, y + left * ny];
  });
  if (extension > 0) {
    for (const [end, sign, list] of [[0, -1, "unshift"], [line.length - 1, 1, "push"]]) {
      const [nx, ny] = normalAt(line, end);
      const [x, y] = moved[end ? moved.length - 1 : 0];
      moved[list]([x + sign * ny * extension, y - sign * nx * extension]);
    }
  }
  return moved;
}

function stripIndex(count) {
  const index = [];
  for (let k = 0; k + 1 < count; k += 1) index.push(2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 2, 2 * k + 1, 2 * k + 3);
  return index;
}

/** A strip between two polylines of equal length that can be given a new course without a new buffer. */
export class Strip {
  constructor(capacity, material, renderOrder) {
    this.capacity = capacity;
    this.count = 0;
    this.geometry = new THREE.BufferGeometry();
    this.positions = new THREE.Float32BufferAttribute(new Float32Array(capacity * 6), 3);
    this.colours = new THREE.Float32BufferAttribute(new Float32Array(capacity * 8), 4);
    this.geometry.setAttribute("position", this.positions);
    this.geometry.setAttribute("color", this.colours);
    this.geometry.setIndex(stripIndex(capacity));
    this.geometry.setDrawRange(0, 0);
    this.mesh = new THREE.Mesh(this.geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = renderOrder;
  }

  /** @param vertex (k, side) -> [x, y, z]; @param alpha (share of the way, side) -> 0 to 1; side 0 is the first line. */
  set(count, vertex, colour, alpha) {
    this.count = Math.min(count, this.capacity);
    for (let k = 0; k < this.count; k += 1) {
      for (const side of [0, 1]) {
        this.positions.setXYZ(2 * k + side, ...vertex(k, side));
        this.colours.setXYZW(2 * k + side, colour.r, colour.g, colour.b, alpha(k / Math.max(this.count - 1, 1), side));
      }
    }
    this.positions.needsUpdate = true;
    this.colours.needsUpdate = true;
    this.skip(0);
  }

  /** Draw from a point on, leaving out those before it; a negative number leaves out all. */
  skip(first) {
    const pieces = first < 0 ? 0 : Math.max(this.count - 1 - first, 0);
    this.geometry.setDrawRange(Math.max(first, 0) * 6, pieces * 6);
  }
}

/** Layers on the ground, lowest first. */
export const LAYERS = { plain: 0, shoulder: 1, road: 2, lane: 3, line: 4, shadow: 5, horizon: 6, reference: 7 };

/**
 * Material of something painted on the ground. Layers lie in one plane, told apart by their depth offset; upper layers are drawn
 * first, so that what they hide costs nothing.
 */
export function paint(layer, settings) {
  const below = LAYERS.reference - layer;
  return new THREE.MeshBasicMaterial({ polygonOffset: true, polygonOffsetFactor: below, polygonOffsetUnits: 8 * below, ...settings });
}

/** Place of a layer in the order of drawing; what is transparent comes after the rest, lowest first. */
export const layerOrder = (layer, isTransparent = false) => (isTransparent ? 20 + layer : 10 - layer);

function flatStrip(left, right, layer, color, opacity) {
  const positions = left.flatMap((point, k) => [...point, 0, ...right[k], 0]);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setIndex(stripIndex(left.length));
  const mesh = new THREE.Mesh(geometry, paint(layer, { color, opacity, transparent: opacity < 1 }));
  mesh.renderOrder = layerOrder(layer, opacity < 1);
  return mesh;
}

/** Flat surface between two polylines of equal length. */
export const surface = (left, right, layer, colour) => flatStrip(left, right, layer, colour, 1);

/** A painted line of a width [m]. */
export const paintedLine = (line, width, layer, colour, opacity = 1) => flatStrip(beside(line, width / 2), beside(line, -width / 2), layer, colour, opacity);

function coneGeometry() {
  const profile = [[0.15, 0.03], [0.115, 0.16], [0.115, 0.16], [0.085, 0.28], [0.085, 0.28], [0.055, 0.39], [0.055, 0.39], [0.025, 0.5], [0, 0.5]];
  const bands = [0xff6a13, 0xf4f4f0, 0xff6a13, 0xff6a13];
  const positions = [];
  const colours = [];
  const add = (vertices, colour) => {
    const { r, g, b } = new THREE.Color(colour);
    for (const vertex of vertices) {
      positions.push(...vertex);
      colours.push(r, g, b);
    }
  };
  const sides = 10;
  const at = ([radius, z], k) => [radius * Math.cos((2 * Math.PI * k) / sides), radius * Math.sin((2 * Math.PI * k) / sides), z];
  for (let band = 0; band < 4; band += 1) {
    const [low, high] = [profile[2 * band], profile[2 * band + 1]];
    for (let k = 0; k < sides; k += 1) add([at(low, k), at(low, k + 1), at(high, k + 1), at(low, k), at(high, k + 1), at(high, k)], bands[band]);
  }
  const foot = new THREE.BoxGeometry(2 * CONE_BASE_M, 2 * CONE_BASE_M, 0.03).toNonIndexed();
  const corner = foot.getAttribute("position");
  for (let k = 0; k < corner.count; k += 1) add([[corner.getX(k), corner.getY(k), corner.getZ(k) + 0.015]], 0xc94d08);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  geometry.computeVertexNormals();
  return geometry;
}

/** Rows of cones along both limits of every lane, one draw call in all. */
export function cones(lanes) {
  const places = [];
  for (const lane of lanes) {
    const steps = Math.max(1, Math.round((lane.end_m - lane.start_m) / CONE_SPACING_M));
    for (let k = 0; k <= steps; k += 1) {
      const x = lane.start_m + ((lane.end_m - lane.start_m) * k) / steps;
      places.push([x, lane.left_m + CONE_BASE_M], [x, lane.right_m - CONE_BASE_M]);
    }
  }
  const material = new THREE.MeshLambertMaterial({ vertexColors: true, emissive: 0x552200 });
  const mesh = new THREE.InstancedMesh(coneGeometry(), material, places.length);
  places.forEach(([x, y], k) => mesh.setMatrixAt(k, new THREE.Matrix4().makeTranslation(x, y, 0)));
  return mesh;
}

/** Short marks across an edge line, one every 10 m; `side` 1 lays them to the left of the line, -1 to the right. */
export function distanceMarks(line, side, layer, color) {
  const places = [];
  let way = 0;
  for (let k = 1; k < line.length; k += 1) {
    const [dx, dy] = [line[k][0] - line[k - 1][0], line[k][1] - line[k - 1][1]];
    const before = way;
    way += Math.hypot(dx, dy);
    if (Math.floor(way / MARK_SPACING_M) > Math.floor(before / MARK_SPACING_M)) places.push([...line[k], Math.atan2(dy, dx)]);
  }
  const geometry = new THREE.PlaneGeometry(0.1, MARK_LENGTH_M).translate(0, (side * MARK_LENGTH_M) / 2, 0);
  const mesh = new THREE.InstancedMesh(geometry, paint(layer, { color }), places.length);
  places.forEach(([x, y, yaw], k) => mesh.setMatrixAt(k, new THREE.Matrix4().makeRotationZ(yaw).setPosition(x, y, 0)));
  mesh.renderOrder = layerOrder(layer);
  return mesh;
}

/** A label over the road that always faces the camera, of one size at any distance; `x`, `y`, `z` of its middle [m]. */
export function sign(text, x, y, z) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [256, 64];
  const context = canvas.getContext("2d");
  context.font = "600 34px system-ui, sans-serif";
  const width = Math.min(context.measureText(text).width + 36, 256);
  context.fillStyle = "rgba(13, 19, 26, 0.8)";
  context.beginPath();
  context.roundRect(128 - width / 2, 4, width, 56, 14);
  context.fill();
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = "#c5d0da";
  context.fillText(text, 128, 33, 236);
  const map = new THREE.CanvasTexture(canvas);
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthWrite: false, sizeAttenuation: false, fog: false }));
  sprite.position.set(x, y, z);
  sprite.scale.set(0.092, 0.023, 1);
  sprite.renderOrder = 40;
  return sprite;
}
