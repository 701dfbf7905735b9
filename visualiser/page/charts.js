// Strip charts of the last seconds. Drawn when asked, from two logs: one of states, one of commands.

import uPlot from "/vendor/uplot/uPlot.esm.js";

const WINDOW_S = 12;
const MAX_ROWS = 800;
const MIN_STEP_S = 0.018; // 50 rows per second are enough for a picture

export const SOLVE_BUDGET_MS = 40; // one control cycle

const DIM = "#7f8e9d";
const GRID = "#1a232c";

/** Rows [t, ...values] of the last seconds. */
export class Log {
  constructor() {
    this.rows = [];
  }

  push(t, ...values) {
    const last = this.rows.at(-1);
    if (last && t < last[0] - 1) this.rows = []; // another run has begun
    else if (last && t < last[0] + MIN_STEP_S) return;
    this.rows.push([t, ...values]);
    if (this.rows.length > MAX_ROWS) this.rows.splice(0, this.rows.length - MAX_ROWS);
  }

  /** Columns for uPlot: seconds before `now`, then the values of the chosen columns. */
  columns(now, chosen) {
    const rows = this.rows.filter(([t]) => t > now - WINDOW_S);
    return [rows.map(([t]) => t - now), ...chosen.map((k) => rows.map((row) => row[k]))];
  }
}

function options(width, height, series, range, hasTimeAxis) {
  const font = "10px system-ui, sans-serif";
  const axis = { stroke: DIM, font, grid: { stroke: GRID, width: 1 }, ticks: { show: false } };
  return {
    width,
    height,
    padding: [6, 8, hasTimeAxis ? 0 : 6, 0],
    legend: { show: false },
    cursor: { show: false },
    scales: { x: { time: false, range: [-WINDOW_S, 0] }, y: { range } },
    axes: [
      { ...axis, size: hasTimeAxis ? 18 : 0, gap: 2, space: 50, values: (_, ticks) => ticks.map((t) => (hasTimeAxis ? `${t} s` : "")) },
      { ...axis, size: 38, gap: 4, space: 15 },
    ],
    series: [{}, ...series.map((one) => ({ width: 1.5, points: { show: false }, ...one }))],
  };
}

/** Range around the data: at least `least` wide about `centre`, never tighter than the data with a margin. */
const around = (least) => (_, low, high) => {
  if (low === null) return [-least, least];
  const span = Math.max(least, Math.abs(low) * 1.15, Math.abs(high) * 1.15);
  return [-span, span];
};

const upTo = (least) => (_, low, high) => [0, Math.max(least, (high ?? 0) * 1.1)];

const near = (least) => (_, low, high) => {
  if (low === null) return [0, least];
  const [middle, half] = [(low + high) / 2, Math.max(least / 2, (high - low) * 0.6)];
  return [Math.min(middle - half, low), Math.max(middle + half, high)];
};

const [GREEN, BLUE, AMBER, WHITE] = ["#3ddc97", "#4aa8ff", "#ffb224", "#c9d4de"];
const DASHED = { dash: [4, 4], width: 1 };

const CHARTS = [
  { id: "chart-solve", log: "commands", columns: [1, 2], range: upTo(SOLVE_BUDGET_MS * 1.1), series: [{ stroke: GREEN, fill: "#3ddc9722" }, { stroke: AMBER, ...DASHED }] },
  { id: "chart-speed", log: "states", columns: [2, 1], range: near(10), series: [{ stroke: DIM, ...DASHED }, { stroke: BLUE }] },
  { id: "chart-lateral", log: "commands", columns: [3], range: around(0.25), series: [{ stroke: WHITE }] },
  { id: "chart-steering", log: "states", columns: [4, 3], range: around(30), series: [{ stroke: DIM, ...DASHED }, { stroke: BLUE }], hasTimeAxis: true },
];

export class Charts {
  constructor() {
    this.logs = { states: new Log(), commands: new Log() };
    this.plots = CHARTS.map((chart) => {
      const element = document.getElementById(chart.id);
      const plot = new uPlot(options(element.clientWidth, element.clientHeight, chart.series, chart.range, chart.hasTimeAxis), [[], ...chart.columns.map(() => [])], element);
      return { ...chart, element, plot };
    });
  }

  pushState(state, reference) {
    this.logs.states.push(state.t_ns / 1e9, state.vx_mps * 3.6, reference, deg(state.sr_angle_rad), deg(state.sr_command_rad));
  }

  pushCommand(command) {
    this.logs.commands.push(command.t_ns / 1e9, command.solve_time_ms, SOLVE_BUDGET_MS, command.lateral_error_m);
  }

  /** @param now time at the right edge, on the senders' clock [s]. */
  draw(now) {
    for (const { element, plot, log, columns } of this.plots) {
      const [width, height] = [element.clientWidth, element.clientHeight];
      if (width !== plot.width || height !== plot.height) plot.setSize({ width, height });
      plot.setData(this.logs[log].columns(now, columns));
    }
  }
}

export const deg = (rad) => (rad * 180) / Math.PI;
