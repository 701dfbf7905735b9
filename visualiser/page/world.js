// The virtual world: what stands still from `scene`, the car, the plan and the objects, and the camera that follows.

import * as THREE from "/vendor/three/three.module.js";
import { Car } from "/car.js";
import { LAYERS, Strip, beside, cones, distanceMarks, layerOrder, paint, paintedLine, points, sign, surface } from "/ground.js";

// Colours are what they say on the screen: converting every pixel between colour spaces would double its cost in software rendering.
THREE.ColorManagement.enabled = false;

const SKY_TOP = 0x0a0f15;
const HAZE = 0x24313d;
const HORIZON_COLOUR = new THREE.Color(0x2ff09b);
const CORRIDOR_COLOUR = new THREE.Color(0x57b4ff);
const REFERENCE_COLOUR = new THREE.Color(0xdfe8f0);
const MAX_PLAN_POINTS = 128;
const HORIZON_WIDTH_M = 0.9;
const CORRIDOR_HEIGHT_M = 0.32;
const CORRIDOR_LEAN_M = 0.2;
const SHOULDER_M = 5; // asphalt beside the road edges
const RUN_ON_M = 150; // and beyond both ends
const GRID_M = 10;
const SIGN_BESIDE_M = 1.3; // left of a gate
const CHASE_PITCH_RAD = 0.21;
const CHASE_DISTANCE_M = 18; // from a point ahead of the car
const CHASE_AHEAD_M = 7;
const BIRD_HEIGHT_M = 46;
const DEFAULT_CAR = { length: 4.36, width: 1.82, front: 2.0, steeringRatio: 15 }; // until the scene comes

const TRANSLUCENT = { vertexColors: true, transparent: true, depthWrite: false, side: THREE.DoubleSide };

const groundStrip = (layer) => new Strip(MAX_PLAN_POINTS, paint(layer, TRANSLUCENT), layerOrder(layer, true));
const fence = () => new Strip(MAX_PLAN_POINTS, new THREE.MeshBasicMaterial(TRANSLUCENT), 30);

/** Without a graphics processor smooth edges would cost as much as all the rest. */
function hasGpu() {
  const context = document.createElement("canvas").getContext("webgl2");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  const isSoftware = names && /swiftshader|llvmpipe|software/i.test(context.getParameter(names.UNMASKED_RENDERER_WEBGL));
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return !isSoftware;
}

export class World {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: hasGpu() });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.scene = new THREE.Scene();
    this.scene.fog = new THREE.Fog(HAZE, 60, 260);
    this.camera = new THREE.PerspectiveCamera(46, 1, 0.5, 700);
    this.camera.up.set(0, 0, 1);
    this.still = new THREE.Group();
    this.objects = new THREE.Group();
    this.scene.add(this.still, this.objects);
    this.addSky();
    this.addLights();
    this.addPlan();
    this.setCar(DEFAULT_CAR);
    this.view = "chase";
    this.orbit = { yaw: 0, pitch: 0, zoom: 1 };
    this.cameraYaw = 0;
    this.isPlaced = false;
  }

  addSky() {
    const geometry = new THREE.SphereGeometry(600, 24, 12, 0, 2 * Math.PI, 0, 0.52 * Math.PI).rotateX(Math.PI / 2);
    const position = geometry.getAttribute("position");
    const [low, high, colours] = [new THREE.Color(HAZE), new THREE.Color(SKY_TOP), []];
    for (let k = 0; k < position.count; k += 1) {
      const share = Math.min(Math.max(position.getZ(k) / 260, 0), 1) ** 0.6;
      const { r, g, b } = low.clone().lerp(high, share);
      colours.push(r, g, b);
    }
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
    const material = new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.BackSide, fog: false, depthWrite: false });
    this.sky = new THREE.Mesh(geometry, material);
    this.sky.renderOrder = layerOrder(LAYERS.plain) + 1;
    this.plain = new THREE.Mesh(new THREE.PlaneGeometry(1400, 1400), paint(LAYERS.plain, { map: gridTexture(1400) }));
    this.plain.renderOrder = layerOrder(LAYERS.plain);
    this.scene.add(this.sky, this.plain);
  }

  addLights() {
    const sun = new THREE.DirectionalLight(0xffffff, 2.1);
    sun.position.set(-6, 3, 9);
    this.scene.add(new THREE.HemisphereLight(0xcfe0f2, 0x39424b, 1.7), sun);
  }

  addPlan() {
    this.path = [];
    this.horizon = groundStrip(LAYERS.horizon);
    this.reference = groundStrip(LAYERS.reference);
    this.borders = [fence(), fence()];
    for (const strip of [this.horizon, this.reference, ...this.borders]) this.scene.add(strip.mesh);
  }

  setCar({ length, width, front, steeringRatio }) {
    if (this.car) this.scene.remove(this.car.group);
    this.car = new Car(length, width, front, steeringRatio);
    this.scene.add(this.car.group);
  }

  setScene(sample) {
    this.setCar({
      length: sample.car_length_m, width: sample.car_width_m, front: sample.car_front_m, steeringRatio: sample.steering_ratio,
    });
    for (const mesh of this.still.children) mesh.geometry.dispose();
    this.still.clear();
    this.isPlaced = false;
    const left = points(sample.left_x_m, sample.left_y_m);
    const right = points(sample.right_x_m, sample.right_y_m);
    if (left.length > 1 && left.length === right.length) this.addRoad(left, right);
    const reference = points(sample.reference_x_m, sample.reference_y_m);
    if (reference.length > 1) this.still.add(paintedLine(reference, 0.07, LAYERS.line, REFERENCE_COLOUR, 0.28));
    for (const lane of sample.lanes) {
      const corners = (y) => [[lane.start_m, y], [lane.end_m, y]];
      this.still.add(surface(corners(lane.left_m), corners(lane.right_m), LAYERS.lane, 0x2b3742));
      this.still.add(sign(lane.name, lane.start_m, lane.left_m + SIGN_BESIDE_M, 0.9));
    }
    if (sample.lanes.length > 0) this.still.add(cones(sample.lanes));
  }

  addRoad(left, right) {
    const edge = 0xaab6c1;
    this.still.add(surface(beside(left, SHOULDER_M, RUN_ON_M), beside(right, -SHOULDER_M, RUN_ON_M), LAYERS.shoulder, 0x191f26));
    this.still.add(surface(left, right, LAYERS.road, 0x242c35));
    this.still.add(paintedLine(left, 0.14, LAYERS.line, edge), paintedLine(right, 0.14, LAYERS.line, edge));
    this.still.add(distanceMarks(left, -1, LAYERS.line, edge), distanceMarks(right, 1, LAYERS.line, edge));
  }

  /** The plan of the controller; undefined takes it away. */
  setPlan(plan) {
    const count = plan ? plan.x_m.length : 0;
    const flat = (line, halfWidth) => {
      const [left, right] = [beside(line, halfWidth), beside(line, -halfWidth)];
      return (k, side) => [...(side ? right : left)[k], 0];
    };
    this.path = plan ? points(plan.x_m, plan.y_m) : [];
    this.horizon.set(count, flat(this.path, HORIZON_WIDTH_M / 2), HORIZON_COLOUR, (share) => 0.85 - 0.7 * share);
    const wanted = plan ? points(plan.reference_x_m, plan.reference_y_m) : [];
    this.reference.set(wanted.length, flat(wanted, 0.05), REFERENCE_COLOUR, () => 0.5);
    ["left", "right"].forEach((name, k) => {
      const foot = plan ? points(plan[`${name}_x_m`], plan[`${name}_y_m`]) : [];
      const top = beside(foot, k ? -CORRIDOR_LEAN_M : CORRIDOR_LEAN_M); // leans outward, to be seen from above as well
      const vertex = (i, side) => (side ? [...top[i], CORRIDOR_HEIGHT_M] : [...foot[i], 0]);
      this.borders[k].set(foot.length, vertex, CORRIDOR_COLOUR, (share, side) => (side ? 0.12 : 0.6) * (1 - 0.6 * share));
    });
  }

  setObjects(objects) {
    while (this.objects.children.length < objects.length) this.objects.add(newObject());
    this.objects.children.forEach((mesh, k) => {
      mesh.visible = k < objects.length;
      if (!mesh.visible) return;
      const object = objects[k];
      mesh.position.set(object.x_m, object.y_m, 0.75);
      mesh.rotation.z = object.yaw_rad;
      mesh.scale.set(object.length_m, object.width_m, 1.5);
    });
  }

  place(pose, speed, steeringWheel, brake, dt) {
    this.car.update(pose, speed, steeringWheel, brake, dt);
    const follow = this.isPlaced ? 1 - Math.exp(-dt / (this.view === "chase" ? 0.35 : 3)) : 1;
    const turn = Math.atan2(Math.sin(pose.yaw - this.cameraYaw), Math.cos(pose.yaw - this.cameraYaw));
    this.cameraYaw += follow * turn;
    this.isPlaced = true;
    this.pose = pose;
    const isBehind = ([x, y]) => (x - pose.x) * Math.cos(pose.yaw) + (y - pose.y) * Math.sin(pose.yaw) < 0;
    const ahead = this.path.findIndex((point) => !isBehind(point));
    for (const strip of [this.horizon, this.reference]) strip.skip(ahead);
    this.plain.position.set(Math.round(pose.x / GRID_M) * GRID_M, Math.round(pose.y / GRID_M) * GRID_M, 0);
  }

  setView(view) {
    this.view = view;
    this.orbit = { yaw: 0, pitch: 0, zoom: 1 };
    this.isPlaced = false;
  }

  aim() {
    const { x, y } = this.pose ?? { x: 0, y: 0 };
    const ahead = (distance, left = 0) => [
      x + distance * Math.cos(this.cameraYaw) - left * Math.sin(this.cameraYaw),
      y + distance * Math.sin(this.cameraYaw) + left * Math.cos(this.cameraYaw),
    ];
    if (this.view === "bird") {
      const height = BIRD_HEIGHT_M * this.orbit.zoom;
      const [cx, cy] = ahead(height * 0.32);
      this.camera.up.set(-Math.sin(this.cameraYaw), Math.cos(this.cameraYaw), 0);
      this.camera.position.set(cx, cy, height);
      this.camera.lookAt(cx, cy, 0);
    } else {
      const yaw = this.cameraYaw + Math.PI + this.orbit.yaw;
      const pitch = Math.min(Math.max(CHASE_PITCH_RAD + this.orbit.pitch, 0.03), 1.4);
      const distance = CHASE_DISTANCE_M * this.orbit.zoom;
      const [tx, ty] = ahead(CHASE_AHEAD_M * Math.max(0, Math.cos(this.orbit.yaw)));
      const level = distance * Math.cos(pitch);
      this.camera.up.set(0, 0, 1);
      this.camera.position.set(tx + level * Math.cos(yaw), ty + level * Math.sin(yaw), 0.8 + distance * Math.sin(pitch));
      this.camera.lookAt(tx, ty, 0.8);
    }
    this.sky.position.copy(this.camera.position);
  }

  render(width, height, pixelRatio) {
    const size = `${width}x${height}@${pixelRatio}`;
    if (size !== this.size) {
      this.size = size;
      this.renderer.setPixelRatio(pixelRatio);
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
    }
    this.aim();
    this.renderer.render(this.scene, this.camera);
  }
}

function gridTexture(size) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 256;
  const context = canvas.getContext("2d");
  context.fillStyle = "#11181f";
  context.fillRect(0, 0, 256, 256);
  context.strokeStyle = "#22303c";
  context.lineWidth = 3;
  context.strokeRect(0, 0, 256, 256);
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(size / GRID_M, size / GRID_M);
  texture.anisotropy = 4;
  return texture;
}

function newObject() {
  const geometry = new THREE.BoxGeometry(1, 1, 1);
  const mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: 0xc2703d }));
  mesh.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry), new THREE.LineBasicMaterial({ color: 0xffc9a3 })));
  return mesh;
}
