// The page's one loop: newest samples in, picture out. The world moves with every picture, figures and charts ten times a second.

import { Charts } from "/charts.js";
import { Hud } from "/hud.js";
import { Link } from "/link.js";
import { PoseTracker } from "/pose.js";
import { World } from "/world.js";

const FIGURES_PERIOD_MS = 100;
const MAX_PIXEL_RATIO = 1.5;
const MIN_PIXEL_RATIO = 0.75;
const MIN_PERIOD_MS = 15; // 60 pictures per second at most: the car may be driven by this very computer
const SLOW_PERIOD_MS = 90;

const canvas = document.getElementById("world");
const charts = new Charts();
const hud = new Hud();
const poses = { state: new PoseTracker(), world: new PoseTracker() };
const world = openWorld();
let shownScene = "";

const link = new Link((topic, sample, arrivedMs) => {
  if (topic in poses) poses[topic].push(sample, arrivedMs);
  if (topic === "state") charts.pushState(sample, referenceKmh(sample));
  if (topic === "command") charts.pushCommand(sample);
  if (topic === "plan") world?.setPlan(sample);
  if (topic === "objects") world?.setObjects(sample.objects);
  if (topic === "scene") showScene(sample);
});

const xilgate = { state: link.samples, stats: { messages: 0, frames: 0, fps: 0, pixelRatio: 1, ageMs: {}, lost: [], horizonPoints: 0, pose: null } };
window.xilgate = xilgate;

function openWorld() {
  try {
    return new World(canvas);
  } catch (error) {
    console.warn(`no virtual world: ${error.message}`);
    document.getElementById("no-webgl").hidden = false;
    return null;
  }
}

function referenceKmh(state) {
  const command = link.fresh("command");
  return command ? (state.vx_mps - command.speed_error_mps) * 3.6 : null;
}

function showScene({ t_ns, seq, ...content }) {
  const text = JSON.stringify(content); // repeated every second; built once
  if (text === shownScene) return;
  shownScene = text;
  world?.setScene(content);
}

function draw(now, dt) {
  const source = link.fresh("world", now) ? "world" : "state"; // ground truth where there is an emulated car, else the estimate
  const pose = poses[source].at(now);
  const sample = link.samples[source];
  if (pose) world.place(pose, link.isLost(source, now) ? 0 : sample.vx_mps, sample.sr_angle_rad, sample.br_position_norm, dt);
  if (link.isLost("objects", now)) world.setObjects([]);
  if (!link.fresh("plan", now) && world.horizon.count > 0) world.setPlan(undefined);
  world.render(canvas.clientWidth, canvas.clientHeight, quality.pixelRatio);
  xilgate.stats.pose = pose;
}

// Keeps drawing cheap: coarser pixels where pictures take long to come.
const quality = {
  pixelRatio: Math.min(window.devicePixelRatio, MAX_PIXEL_RATIO),
  isAdaptive: true,
  periodMs: MIN_PERIOD_MS,
  note(periodMs) {
    this.periodMs += 0.04 * (Math.min(periodMs, 200) - this.periodMs);
    if (this.isAdaptive && this.periodMs > SLOW_PERIOD_MS && this.pixelRatio > MIN_PIXEL_RATIO) {
      this.pixelRatio = Math.max(MIN_PIXEL_RATIO, this.pixelRatio * 0.9);
      this.periodMs = MIN_PERIOD_MS;
    }
  },
};
xilgate.quality = quality;

let [lastDrawMs, lastFiguresMs, framesAtFigures] = [performance.now(), 0, 0];

function frame() {
  requestAnimationFrame(frame);
  const now = performance.now();
  if (world && now - lastDrawMs >= MIN_PERIOD_MS) {
    const periodMs = now - lastDrawMs;
    lastDrawMs = now;
    draw(now, Math.min(periodMs / 1000, 0.2));
    quality.note(periodMs);
    xilgate.stats.frames += 1;
  }
  if (now - lastFiguresMs >= FIGURES_PERIOD_MS) writeFigures(now);
}

function writeFigures(now) {
  hud.update(link, now);
  const newest = Math.max(...["state", "command"].map((topic) => link.samples[topic]?.t_ns ?? 0)) / 1e9;
  charts.draw(newest);
  const { stats } = xilgate;
  const rate = ((stats.frames - framesAtFigures) * 1000) / (now - lastFiguresMs);
  stats.fps += 0.2 * (rate - stats.fps);
  [lastFiguresMs, framesAtFigures] = [now, stats.frames];
  stats.messages = link.messages;
  stats.pixelRatio = quality.pixelRatio;
  stats.ageMs = Object.fromEntries(Object.keys(link.samples).map((topic) => [topic, link.ageMs(topic, now)]));
  stats.lost = link.lostTopics(now);
  stats.horizonPoints = world?.horizon.count ?? 0;
}

const buttons = [...document.querySelectorAll("#camera button")];

function setView(view) {
  world?.setView(view);
  for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.view === view));
}

for (const button of buttons) button.addEventListener("click", () => setView(button.dataset.view));
window.addEventListener("keydown", (event) => {
  if (event.key === "b" && world) setView(world.view === "bird" ? "chase" : "bird");
});
canvas.addEventListener("pointermove", (event) => {
  if (!world || event.buttons === 0) return;
  world.orbit.yaw -= event.movementX * 0.006;
  world.orbit.pitch += event.movementY * 0.004;
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (world) world.orbit.zoom = Math.min(Math.max(world.orbit.zoom * Math.exp(event.deltaY * 0.001), 0.5), 4);
}, { passive: false });

requestAnimationFrame(frame);
