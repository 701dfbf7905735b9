"use strict";
// Draws the plots of a report. All data are in the page; times are seconds since the start of the run.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colour = {
    ink: css("--ink"), quiet: css("--quiet"), line: css("--line"), driven: css("--driven"), wanted: css("--wanted"),
    fail: css("--fail"), pass: css("--pass"), cone: css("--cone"), judged: css("--judged"), tint: css("--tint"),
  };
  const MODE_COLOURS = { SILENT: colour.line, STANDBY: colour.line, READY: colour.wanted, ENGAGED: colour.pass, COMFORT_STOP: colour.cone, SAFE_STOP: colour.cone, FAULT: colour.fail };
  const AXIS_PX = 52, HEIGHT_PX = 190, FONT = "12px system-ui, sans-serif";
  const plots = [];

  function axis(more) {
    return { stroke: colour.quiet, font: FONT, grid: { stroke: colour.line, width: 1 }, ticks: { show: false }, gap: 6, ...more };
  }

  function shadeJudged(u) {
    const [from, to] = data.judged_s.map((t) => u.valToPos(t, "x", true));
    u.ctx.fillStyle = colour.judged;
    const left = Math.max(from, u.bbox.left), right = Math.min(to, u.bbox.left + u.bbox.width);
    if (right > left) u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
  }

  function drawLimits(u, { limits, limits_hold_s: [from, to] }) {
    u.ctx.save();
    u.ctx.strokeStyle = colour.fail;
    u.ctx.lineWidth = devicePixelRatio;
    u.ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const limit of limits) {
      const y = u.valToPos(limit, "y", true);
      u.ctx.beginPath();
      u.ctx.moveTo(Math.max(u.valToPos(from, "x", true), u.bbox.left), y);
      u.ctx.lineTo(Math.min(u.valToPos(to, "x", true), u.bbox.left + u.bbox.width), y);
      u.ctx.stroke();
    }
    u.ctx.restore();
  }

  // A plot of a quiet signal keeps a span around it, so that noise does not look like movement.
  function span(limits, unit) {
    const least = { "km/h": 10, deg: 4, m: 0.2, "%": 10, ms: 5 }[unit] ?? 2;
    return (u, low, high) => {
      const all = [low ?? 0, high ?? 0, ...limits];
      const middle = (Math.min(...all) + Math.max(...all)) / 2;
      const half = Math.max((Math.max(...all) - Math.min(...all)) / 2, least / 2) * 1.08;
      return unit === "%" || unit === "ms" ? [Math.min(0, low ?? 0), middle + half] : [middle - half, middle + half];
    };
  }

  const common = {
    scales: { x: { time: false, range: (u, low, high) => [Math.max(low, 0), Math.min(high, data.end_s)] } },
    cursor: { sync: { key: "run" }, y: false, points: { size: 6 }, drag: { x: true, y: false } },
    legend: { show: false },
  };

  let isZooming = false;
  function follow(u, key) {
    if (key !== "x" || isZooming) return;
    isZooming = true;
    for (const other of plots) if (other !== u) other.setScale("x", { min: u.scales.x.min, max: u.scales.x.max });
    isZooming = false;
  }

  function readout(u, plot, element) {
    const k = u.cursor.idx;
    element.textContent = k == null ? plot.unit : plot.data.slice(1).map((values) => values[k].toFixed(2)).join(" / ") + " " + plot.unit;
  }

  function lineOf(name) {
    const isWanted = name === "reference" || name === "commanded";
    return { label: name, stroke: isWanted ? colour.wanted : colour.driven, width: 1.5, dash: isWanted ? [6, 4] : undefined, points: { show: false } };
  }

  function addPlot(plot) {
    const box = document.createElement("div");
    box.className = "plot";
    box.innerHTML = "<h3></h3>";
    const value = document.createElement("span");
    const title = document.createElement("div");
    title.textContent = plot.title;
    for (const name of plot.lines) {
      const key = document.createElement("i");
      key.style.borderTopColor = lineOf(name).stroke;
      key.style.borderTopStyle = lineOf(name).dash ? "dashed" : "solid";
      const label = document.createElement("span");
      label.textContent = name;
      title.append(key, label);
    }
    box.firstChild.append(title, value);
    document.getElementById("plots").append(box);
    const u = new uPlot({
      ...common, width: box.clientWidth, height: HEIGHT_PX,
      scales: { ...common.scales, y: { range: span(plot.limits, plot.unit) } },
      series: [{}, ...plot.lines.map(lineOf)],
      axes: [axis({ size: 26, values: (self, ticks) => ticks.map((t) => t + " s") }), axis({ size: AXIS_PX })],
      hooks: {
        drawClear: [shadeJudged],
        draw: [(self) => drawLimits(self, plot)],
        setCursor: [(self) => { readout(self, plot, value); moveMarker(self); }],
        setScale: [follow],
      },
    }, plot.data, box);
    value.textContent = plot.unit;
    plots.push(u);
    return { u, box };
  }

  function addModes() {
    const box = document.getElementById("modes");
    const bands = data.modes.map((change, k) => ({ ...change, until: data.modes[k + 1]?.t_s ?? data.end_s }));
    const u = new uPlot({
      ...common, width: box.clientWidth, height: 62,
      scales: { ...common.scales, y: { range: [0, 1] } },
      series: [{}, { show: false }],
      axes: [axis({ size: 26, values: (self, ticks) => ticks.map((t) => t + " s") }), { show: false }],
      hooks: { draw: [(self) => drawModes(self, bands)], setScale: [follow] },
    }, [[0, data.end_s], [0, 0]], box);
    plots.push(u);
    return { u, box };
  }

  function drawModes(u, bands) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textBaseline = "middle";
    ctx.textAlign = "left";
    for (const band of bands) {
      const from = u.valToPos(band.t_s, "x", true), to = u.valToPos(band.until, "x", true);
      ctx.globalAlpha = 0.25;
      ctx.fillStyle = MODE_COLOURS[band.mode] ?? colour.quiet;
      ctx.fillRect(from, bbox.top, to - from, bbox.height);
      ctx.globalAlpha = 1;
      ctx.fillRect(from, bbox.top, 2 * devicePixelRatio, bbox.height);
      ctx.fillStyle = colour.ink;
      ctx.fillText(label(ctx, band, to - from - 14 * devicePixelRatio), from + 8 * devicePixelRatio, bbox.top + bbox.height / 2);
    }
    ctx.restore();
  }

  function label(ctx, band, room) {
    const texts = [band.reason ? `${band.mode}: ${band.reason}` : band.mode, band.mode];
    return texts.find((text) => ctx.measureText(text).width <= room) ?? "";
  }

  function moveMarker(u) {
    const marker = document.getElementById("marker"), drive = data.marker;
    if (!marker) return;
    if (u.cursor.left == null || u.cursor.left < 0) { marker.setAttribute("d", ""); return; }
    const t = u.posToVal(u.cursor.left, "x");
    let k = drive.t.findIndex((time) => time >= t);
    if (k < 0) k = drive.t.length - 1;
    const [front, rear, half] = drive.car, [left, x0, top, scale, larger] = drive.scale;
    const cos = Math.cos(drive.yaw[k]), sin = Math.sin(drive.yaw[k]);
    const corners = [[front, half], [-rear, half], [-rear, -half], [front, -half]].map(([a, b]) => {
      const x = drive.x[k] + a * cos - b * sin, y = drive.y[k] + a * sin + b * cos;
      return `${(left + (x - x0) * scale).toFixed(1)} ${((top - y) * scale * larger).toFixed(1)}`;
    });
    marker.setAttribute("d", `M${corners.join("L")}Z`);
  }

  if (data.plots.length === 0) return;
  const drawn = [addModes(), ...data.plots.map(addPlot)];
  const fit = () => { for (const { u, box } of drawn) u.setSize({ width: box.clientWidth, height: u.height }); };
  addEventListener("resize", fit);
  addEventListener("beforeprint", fit);
})();
