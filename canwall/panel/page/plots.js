// Plots over time as bands from the lowest to the highest value, so that no peak is lost.

import { colours, onTheme } from "./theme.js";
import { CalmRange, fixed } from "./numbers.js";

const FONT = '13px system-ui, "Segoe UI", Roboto, "Noto Sans", sans-serif';

/** What all axes look like. */
export function axis(options) {
  return {
    stroke: colours.muted,
    font: FONT,
    grid: { stroke: colours.line, width: 1 },
    ticks: { stroke: colours.line, width: 1, size: 4 },
    ...options,
  };
}

/** A uPlot that fills its place, follows its size, and is made anew for another theme. */
export class Plot {
  constructor(place, options, data) {
    this.place = place;
    this.options = options;
    this.data = data;
    onTheme(() => this.#make());
    new ResizeObserver(() => {
      const { clientWidth: width, clientHeight: height } = place;
      if (this.u && width && height && (width !== this.u.width || height !== this.u.height)) {
        this.u.setSize({ width, height });
      } else if (!this.u) this.#make();
    }).observe(place);
  }

  #make() {
    const { clientWidth: width, clientHeight: height } = this.place;
    this.u?.destroy();
    this.u = null;
    if (!width || !height || !colours.text) return;
    this.u = new window.uPlot(
      { width, height, pxAlign: 0, legend: { show: false }, ...this.options() },
      this.data,
      this.place,
    );
  }

  draw(data) {
    this.data = data;
    this.u?.setData(data);
  }
}

/** Lines of a band: two series, and the fill between them. */
function bandSeries(bands) {
  const series = [{}];
  const fills = [];
  bands.forEach(({ colour, dash, width = 1.5 }) => {
    const line = { stroke: colours[colour], width, dash, points: { show: false }, spanGaps: false };
    series.push(line, { ...line });
    fills.push({ series: [series.length - 1, series.length - 2], fill: colours[colour] + "55" });
  });
  return { series, bands: fills };
}

/** Hatches the wall's inside below 0, or above. */
function hatchWall(u, column) {
  const { ctx, bbox } = u;
  const surface = u.valToPos(0, "y", true);
  const bottom = bbox.top + bbox.height;
  if (column !== "y" || surface >= bottom) return;
  const ratio = devicePixelRatio;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, surface, bbox.width, bottom - surface);
  ctx.fillStyle = colours.wall;
  ctx.fill();
  ctx.clip();
  ctx.strokeStyle = colours["wall-edge"];
  ctx.globalAlpha = 0.35;
  ctx.lineWidth = ratio;
  ctx.beginPath();
  const depth = bottom - surface;
  for (let x = bbox.left - depth; x < bbox.left + bbox.width; x += 11 * ratio) {
    ctx.moveTo(x, bottom);
    ctx.lineTo(x + depth, surface);
  }
  ctx.stroke();
  ctx.globalAlpha = 1;
  ctx.lineWidth = 1.5 * ratio;
  ctx.beginPath();
  ctx.moveTo(bbox.left, surface);
  ctx.lineTo(bbox.left + bbox.width, surface);
  ctx.stroke();
  ctx.restore();
}

/**
 * Options of a plot of bands over time.
 * @param {object} what bands: [{colour, dash}], scales: x and y of uPlot, wall: hatch below 0,
 *   axisless: no labels below, cursor, hooks
 */
export function bandOptions({ bands, scales, column, labels = true, decimals, cursor, hooks = {}, time }) {
  return () => ({
    ...bandSeries(bands),
    padding: [8, 24, labels ? 0 : 8, 0],
    scales: { x: { time: false, ...scales.x }, y: { auto: false, ...scales.y } },
    axes: [
      axis({ size: labels ? 26 : 0, values: (u, ticks) => ticks.map((t) => (labels ? time(t) : "")) }),
      axis({ size: 58, space: 26, values: (u, ticks) => ticks.map((value) => fixed(value, decimals(u))) }),
    ],
    cursor: cursor ?? { show: false },
    hooks: { drawClear: [(u) => hatchWall(u, column)], ...hooks },
  });
}

/** Decimals that tell the ticks of a scale apart. */
export function decimals(u) {
  const span = u.scales.y.max - u.scales.y.min;
  return Math.min(Math.max(1 - Math.floor(Math.log10(span / 4 || 1)), 0), 5);
}

/** Plot of the last seconds of columns of a History. */
export class RollingPlot {
  #above;
  #below;
  #factor;

  constructor(place, history, { columns, bands, factor = 1, least, window, labels }) {
    this.history = history;
    this.columns = columns;
    this.window = window;
    this.#factor = factor;
    this.#above = new CalmRange(least);
    this.#below = new CalmRange(0.15 * least);
    this.scaled = columns.flatMap(() => [0, 1].map(() => new Float32Array(history.capacity)));
    this.top = least;
    this.bottom = -least;
    const empty = [new Float64Array(0), ...this.scaled.map((each) => each.subarray(0, 0))];
    this.plot = new Plot(place, bandOptions({
      bands,
      column: bands[0].colour === "position" ? "y" : "",
      scales: {
        x: { range: () => [this.now - window, this.now] },
        y: { range: () => [this.bottom, this.top] },
      },
      labels,
      decimals,
      time: (t) => `${Math.round(t * 10) / 10} s`,
    }), empty);
    this.now = 0;
  }

  draw(milliseconds) {
    const { history } = this;
    this.now = history.now || 0;
    const [begin, end] = history.since(this.now - this.window);
    const n = end - begin;
    const data = [history.t.subarray(begin, end)];
    let highest = 0;
    let lowest = 0;
    this.columns.forEach((column, c) => {
      const low = this.scaled[2 * c];
      const high = this.scaled[2 * c + 1];
      for (let i = 0; i < n; i++) {
        low[i] = history.low[column][begin + i] * this.#factor;
        high[i] = history.high[column][begin + i] * this.#factor;
        if (low[i] < lowest) lowest = low[i];
        if (high[i] > highest) highest = high[i];
      }
      data.push(low.subarray(0, n), high.subarray(0, n));
    });
    this.top = this.#above.take(highest, milliseconds);
    this.bottom = -this.#below.take(Math.max(-lowest, 0.15 * this.top), milliseconds);
    this.plot.draw(data);
  }
}
