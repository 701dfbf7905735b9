// Smooth motion out of samples that arrive when they like: dead reckoning from the newest sample, on the sender's clock.

const MAX_EXTRAPOLATION_S = 0.25;
const CORRECTION_S = 0.08; // time constant with which a jump between prediction and new sample fades
const JUMP_M = 5; // a car that is elsewhere was put there: no fading
const CLOCK_DRIFT = 0.02; // share by which the clock offset follows later arrivals; earlier ones it follows at once

const wrap = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

function extrapolate(s, dt) {
  const yaw = s.yaw_rad + (s.yaw_rate_radps * dt) / 2;
  return {
    x: s.x_m + (s.vx_mps * Math.cos(yaw) - s.vy_mps * Math.sin(yaw)) * dt,
    y: s.y_m + (s.vx_mps * Math.sin(yaw) + s.vy_mps * Math.cos(yaw)) * dt,
    yaw: s.yaw_rad + s.yaw_rate_radps * dt,
  };
}

export class PoseTracker {
  constructor() {
    this.sample = null;
    this.offsetMs = 0; // browser clock minus sender's clock
    this.error = { x: 0, y: 0, yaw: 0, atMs: 0 };
  }

  push(sample, arrivedMs) {
    const before = this.at(arrivedMs);
    const offsetMs = arrivedMs - sample.t_ns / 1e6;
    const isFirst = this.sample === null || Math.abs(offsetMs - this.offsetMs) > 1000;
    this.offsetMs = isFirst || offsetMs < this.offsetMs ? offsetMs : this.offsetMs + CLOCK_DRIFT * (offsetMs - this.offsetMs);
    this.sample = sample;
    this.error = { x: 0, y: 0, yaw: 0, atMs: arrivedMs };
    if (before === null) return;
    const after = this.at(arrivedMs);
    const [x, y] = [before.x - after.x, before.y - after.y];
    if (Math.hypot(x, y) < JUMP_M) this.error = { x, y, yaw: wrap(before.yaw - after.yaw), atMs: arrivedMs };
  }

  /** Pose {x, y [m], yaw [rad]} at a time of the browser's clock [ms]; null before the first sample. */
  at(nowMs) {
    if (this.sample === null) return null;
    const dt = (nowMs - this.offsetMs - this.sample.t_ns / 1e6) / 1000;
    const pose = extrapolate(this.sample, Math.min(Math.max(dt, 0), MAX_EXTRAPOLATION_S));
    const share = Math.exp(-(nowMs - this.error.atMs) / 1000 / CORRECTION_S);
    return { x: pose.x + share * this.error.x, y: pose.y + share * this.error.y, yaw: pose.yaw + share * this.error.yaw };
  }
}
