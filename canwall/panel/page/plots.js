// Plots over time as bands from the lowest to the highest value, so that no peak is lost.

import { hatch } from "./hatch.js";
import { CalmRange, fixed } from "./numbers.js";
import { colours, onTheme } from "./theme.js";

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

/** A band: of its two series, the highest values draw the outline of both. */
function bandSeries(bands) {
  return [{}, ...bands.flatMap(({ colour, dash, width = 1.5 }) => [
    { paths: () => null, points: { show: false } },
    {
      paths: bandPath, stroke: colours[colour], fill: colours[colour] + "55", width, dash, points: { show: false },
    },
  ])];
}

function bandPath(u, series, first, last) {
  const band = { t: u.data[0], low: u.data[series - 1], high: u.data[series] };
  return outline(u, band, { first, last, dashed: Boolean(u.series[series].dash) });
}

/**
 * Paths of a band, in parts where values are missing: the highest from left to right, the lowest back.
 * @returns {{fill: Path2D, stroke: Path2D}}
 */
export function outline(u, { t, low, high }, { first = 0, last = t.length - 1, dashed = false, shift = 0, factor = 1 }) {
  const x0 = u.valToPos(0, "x", true);
  const y0 = u.valToPos(0, "y", true);
  const dx = u.valToPos(1, "x", true) - x0;
  const dy = u.valToPos(1, "y", true) - y0;
  const x = (i) => x0 + dx * (t[i] + shift);
  const y = (value) => y0 + dy * factor * value;
  const fill = new Path2D();
  // Dashes that go there and back would fill each other's gaps.
  const stroke = dashed ? new Path2D() : fill;
  for (let begin = first, end; begin <= last; begin = end + 1) {
    for (end = begin; end <= last && Number.isFinite(high[end]); end++);
    if (end === begin) continue;
    fill.moveTo(x(begin), y(high[begin]));
    for (let i = begin + 1; i < end; i++) fill.lineTo(x(i), y(high[i]));
    for (let i = end - 1; i >= begin; i--) fill.lineTo(x(i), y(low[i]));
    if (stroke === fill) continue;
    for (const values of [low, high]) {
      stroke.moveTo(x(begin), y(values[begin]));
      for (let i = begin + 1; i < end; i++) stroke.lineTo(x(i), y(values[i]));
    }
  }
  return { stroke, fill };
}

/** Hatches the wall's inside below 0. */
function hatchWall(u, column) {
  const { ctx, bbox } = u;
  const surface = u.valToPos(0, "y", true);
  const bottom = bbox.top + bbox.height;
  if (column !== "y" || surface >= bottom) return;
  ctx.save();
  hatch(ctx, bbox.left, surface, bbox.width, bottom - surface);
  ctx.strokeStyle = colours["wall-edge"];
  ctx.lineWidth = 1.5 * devicePixelRatio;
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
    series: bandSeries(bands),
    padding: [8, 24, labels ? 0 : 8, 0],
    scales: { x: { time: false, ...scales.x }, y: { auto: false, ...scales.y } },
    axes: [
      axis({ size: labels ? 26 : 0, space: 80, values: (u, ticks) => ticks.map((t) => (labels ? time(t) : "")) }),
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
    this.t = new Float64Array(history.capacity);
    this.scaled = columns.flatMap(() => [0, 1].map(() => new Float32Array(history.capacity)));
    this.top = least;
    this.bottom = -least;
    const empty = [this.t, ...this.scaled].map((each) => each.subarray(0, 0));
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
    // As many points as pixels: of several in one, the lowest and the highest. They stay together
    // as they move.
    const together = Math.ceil((end - begin) / (this.plot.u?.bbox.width || end - begin || 1));
    const first = (begin + history.count - end) % together;
    let n = 0;
    let highest = 0;
    let lowest = 0;
    for (let i = begin; i < end; n++) {
      const next = Math.min(i + together - (n ? 0 : first), end);
      this.columns.forEach((column, c) => {
        let low = NaN;
        let high = NaN;
        for (let k = i; k < next; k++) {
          if (low !== low || history.low[column][k] < low) low = history.low[column][k];
          if (high !== high || history.high[column][k] > high) high = history.high[column][k];
        }
        this.scaled[2 * c][n] = low *= this.#factor;
        this.scaled[2 * c + 1][n] = high *= this.#factor;
        if (low < lowest) lowest = low;
        if (high > highest) highest = high;
      });
      this.t[n] = history.t[next - 1];
      i = next;
    }
    const data = [this.t, ...this.scaled].map((each) => each.subarray(0, n));
    this.top = this.#above.take(highest, milliseconds);
    this.bottom = -this.#below.take(Math.max(-lowest, 0.15 * this.top), milliseconds);
    this.plot.draw(data);
  }
}
