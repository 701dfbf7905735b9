// Words and numbers of the page. Writes to the document only what has changed.

import { SOLVE_BUDGET_MS, deg } from "/charts.js";
import { TOPICS } from "/link.js";

const SR_BAR_DEG = 180; // full scale of the bar
const REASONS_SHOWN = 4;

const element = (id) => document.getElementById(id);

function write(id, text) {
  const target = element(id);
  if (target.textContent !== text) target.textContent = text;
}

function mark(id, name, value) {
  const target = element(id);
  if (target.dataset[name] !== value) target.dataset[name] = value;
}

const show = (id, isShown) => {
  element(id).hidden = !isShown;
};

const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;
const clip = (value, low, high) => Math.min(Math.max(value, low), high);
const sum = (counts) => Object.values(counts).reduce((total, count) => total + count, 0);
const age = (ms) => (ms < 1000 ? `${ms.toFixed(0)} ms` : ms < 100000 ? `${(ms / 1000).toFixed(1)} s` : "> 99 s");

function bar(id, share, command) {
  const [fill, tick] = element(id).children;
  fill.style.transform = `scaleX(${share.toFixed(3)})`;
  if (tick) tick.style.left = `calc(${(command * 100).toFixed(1)}% - 1px)`;
}

export class Hud {
  constructor() {
    element("ages").replaceChildren(...TOPICS.map((topic) => {
      const item = document.createElement("li");
      item.id = `link-${topic}`;
      item.append(topic, Object.assign(document.createElement("output"), { id: `age-${topic}`, textContent: "–" }));
      return item;
    }));
  }

  update(link, now) {
    const { state, status, command, scene } = link.samples;
    this.writeMode(link, now);
    this.writeLinks(link, now);
    if (state) this.writeState(state, command);
    if (command) this.writeCommand(command);
    if (status) this.writeStatus(status, link.rejected);
    if (scene) {
      write("scenario", scene.scenario);
      write("run-stage", scene.stage.toUpperCase());
      show("run-stage", true);
    }
  }

  writeMode(link, now) {
    const { state, status } = link.samples;
    const isKnown = link.fresh("state", now) ?? link.fresh("status", now);
    const mode = (state ?? status)?.mode;
    mark("mode", "mode", isKnown ? mode : "NONE");
    write("mode", isKnown ? mode.replace("_", " ") : "NO LINK");
    const lastKnown = mode ? `last known: ${mode.replace("_", " ")}` : "";
    write("reason", isKnown ? status?.reason ?? "" : lastKnown);
    const blockers = isKnown ? status?.blockers ?? [] : [];
    const more = blockers.length > REASONS_SHOWN ? ` and ${blockers.length - REASONS_SHOWN} more` : "";
    write("blockers", `waits for: ${blockers.slice(0, REASONS_SHOWN).join(", ")}${more}`);
    show("blockers", blockers.length > 0);
  }

  writeLinks(link, now) {
    for (const topic of TOPICS) {
      const ageMs = link.ageMs(topic, now);
      write(`age-${topic}`, ageMs === null ? "–" : age(ageMs));
      mark(`link-${topic}`, "link", ageMs === null ? "none" : link.isLost(topic, now) ? "lost" : "fresh");
    }
    const lost = link.lostTopics(now);
    const isWaiting = Object.keys(link.samples).length === 0;
    const isBridgeLost = link.isBridgeLost(now);
    show("lost", lost.length > 0 || isBridgeLost || isWaiting);
    mark("lost", "kind", isWaiting && !isBridgeLost ? "waiting" : "lost");
    document.body.dataset.stale = String(isBridgeLost || lost.includes("state"));
    if (isBridgeLost) {
      write("lost-title", "BRIDGE LOST");
      write("lost-detail", "the view does not answer; trying again");
    } else if (isWaiting) {
      write("lost-title", "WAITING FOR TELEMETRY");
      write("lost-detail", "no process has published yet");
    } else if (lost.length > 0) {
      write("lost-title", "LINK LOST");
      const isSilent = Object.keys(link.samples).every((topic) => topic === "scene" || lost.includes(topic));
      const newestMs = Math.min(...lost.map((topic) => link.ageMs(topic, now)));
      write("lost-detail", `no ${isSilent ? "telemetry" : lost.join(", ")} for ${age(newestMs)}`);
    }
  }

  writeState(state, command) {
    const speed = state.vx_mps * 3.6;
    write("speed", Math.abs(speed).toFixed(1));
    write("speed-reference", command ? `${(speed - command.speed_error_mps * 3.6).toFixed(1)} km/h` : "–");
    const angle = deg(state.sr_angle_rad);
    write("sr", `${signed(angle, 0)}°`);
    write("steering", `${signed(angle, 1)}°`);
    write("ar", `${(state.ar_position_norm * 100).toFixed(0)} %`);
    write("br", `${(state.br_position_norm * 100).toFixed(0)} %`);
    element("steering-wheel-turn").setAttribute("transform", `rotate(${(-angle).toFixed(1)})`);
    const half = (value) => clip(value / SR_BAR_DEG, -1, 1);
    bar("sr-bar", -half(angle), 0.5 - half(deg(state.sr_command_rad)) / 2); // left on the left
    bar("ar-bar", clip(state.ar_position_norm, 0, 1), clip(state.ar_command_norm, 0, 1));
    bar("br-bar", clip(state.br_position_norm, 0, 1), clip(state.br_command_norm, 0, 1));
  }

  writeCommand(command) {
    const share = command.solve_time_ms / SOLVE_BUDGET_MS;
    write("solve-time", `${command.solve_time_ms.toFixed(1)} of ${SOLVE_BUDGET_MS} ms`);
    bar("solve-bar", clip(share, 0, 1));
    mark("solve-bar", "level", share > 1 ? "over" : share > 0.6 ? "high" : "low");
    write("solver", command.solver);
    write("iterations", `${command.sqp_iterations} SQP iterations`);
    write("command-status", command.status);
    mark("command-status", "status", command.status);
    write("lateral-error", `${signed(command.lateral_error_m, 3)} m`);
    write("speed-error", `error ${signed(command.speed_error_mps * 3.6, 1)} km/h`);
  }

  writeStatus(status, ignored) {
    const rejected = sum(status.frames_rejected) + sum(status.commands_rejected) + ignored;
    write("frames", status.frames_received.toLocaleString("en"));
    write("rejected", rejected.toLocaleString("en"));
    mark("rejected", "level", rejected > 0 ? "high" : "none");
    write("late", status.ticks_late.toLocaleString("en"));
    write("step-cpu", `${status.step_cpu_ms.toFixed(2)} ms`);
    write("command-age", status.command_age_ms < 10000 ? `command age ${status.command_age_ms.toFixed(0)} ms` : "no command");
  }
}
