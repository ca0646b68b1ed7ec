// Force over penetration, contact by contact, with the line of the referent.

import { Plot, axis } from "./plots.js";
import { CalmRange, digits, fixed, known } from "./numbers.js";
import { setText } from "./readings.js";
import { colours } from "./theme.js";

const KEPT = 8192; // points of the running contact
const EARLIER = 3;

export class ContactPlot {
  #depth = new Float32Array(KEPT);
  #force = new Float32Array(KEPT);
  #count = 0;
  #earlier = [];
  #depths = new CalmRange(5, 4000);
  #forces = new CalmRange(0.1, 4000);
  #highest = { depth: 0, force: 0 };
  // The lines so far, in the scale that they were drawn in; of the running contact up to a point.
  #layer = new OffscreenCanvas(1, 1);
  #scale = "";
  #drawn = 0;
  #latest = "";

  constructor(place, caption) {
    this.caption = caption;
    this.stiffness = NaN;
    this.reach = { depth: 5, force: 0.1 };
    this.plot = new Plot(place, () => ({
      padding: [10, 14, 0, 0],
      scales: {
        x: { time: false, range: () => [-0.08 * this.reach.depth, this.reach.depth] },
        y: { auto: false, range: () => [-0.15 * this.reach.force, this.reach.force] },
      },
      axes: [
        axis({ size: 44, label: "penetration [mrad]", labelSize: 18, labelFont: "13px system-ui, sans-serif", values: (u, ticks) => ticks.map((value) => digits(value, 2)) }),
        axis({ size: 58, space: 44, values: (u, ticks) => ticks.map((value) => fixed(value, this.reach.force < 0.5 ? 2 : 1)) }),
      ],
      series: [{}, { stroke: colours.referent, width: 2, dash: [8, 6], points: { show: false } }],
      cursor: { show: false },
      hooks: { draw: [(u) => this.#loops(u)] },
    }), [[0, 1], [NaN, NaN]]);
  }

  /** Take new points of the running contact; none begin another contact. */
  append({ n, stiffness, y, force }) {
    if (n === 0) this.#begin();
    this.stiffness = stiffness;
    for (let i = 0; i < n; i++) {
      const at = this.#count++ % KEPT;
      this.#depth[at] = -1e3 * y[i];
      this.#force[at] = force[i];
      this.#highest.depth = Math.max(this.#highest.depth, -1e3 * y[i]);
      this.#highest.force = Math.max(this.#highest.force, force[i]);
    }
  }

  clear() {
    this.#count = 0;
    this.#earlier = [];
    this.#scale = this.#latest = "";
  }

  #begin() {
    if (this.#count > 4) {
      const [begin, end] = this.#kept();
      const stride = Math.ceil((end - begin) / 1000);
      const n = Math.floor((end - begin) / stride);
      const old = { depth: new Float32Array(n), force: new Float32Array(n) };
      for (let i = 0; i < n; i++) {
        const at = (begin + i * stride) % KEPT;
        old.depth[i] = this.#depth[at];
        old.force[i] = this.#force[at];
      }
      this.#earlier.unshift(old);
      this.#earlier.length = Math.min(this.#earlier.length, EARLIER);
    }
    this.#count = 0;
    this.#highest = { depth: 0, force: 0 };
    this.#scale = "";
  }

  #kept() {
    return [Math.max(0, this.#count - KEPT), this.#count];
  }

  draw(milliseconds) {
    this.reach.depth = this.#depths.take(this.#highest.depth, milliseconds);
    this.reach.force = this.#forces.take(this.#highest.force, milliseconds);
    const line = known(this.stiffness) ? this.stiffness : NaN;
    const latest = [this.#count, this.reach.depth, this.reach.force, line].join();
    if (latest === this.#latest) return;
    this.#latest = latest;
    setText(this.caption, known(line) ? `${digits(line, 3)} N·m/rad` : "");
    this.plot.draw([[0, this.reach.depth], [line * 0, line * this.reach.depth * 1e-3]]);
  }

  #loops(u) {
    const { left, top, width, height } = u.bbox;
    const x0 = u.valToPos(0, "x", true) - left;
    const y0 = u.valToPos(0, "y", true) - top;
    const dx = u.valToPos(1, "x", true) - left - x0;
    const dy = u.valToPos(1, "y", true) - top - y0;
    const scale = [width, height, x0, y0, dx, dy, colours.force, colours.muted].join();
    const ctx = this.#layer.getContext("2d");
    if (scale !== this.#scale) {
      this.#scale = scale;
      this.#layer.width = width; // clears it
      this.#layer.height = height;
      this.#drawn = 0;
      ctx.lineJoin = "round";
      ctx.strokeStyle = colours.muted;
      ctx.lineWidth = devicePixelRatio;
      ctx.globalAlpha = 0.45;
      for (const { depth, force } of this.#earlier) {
        ctx.beginPath();
        for (let i = 0; i < depth.length; i++) ctx.lineTo(x0 + dx * depth[i], y0 + dy * force[i]);
        ctx.stroke();
      }
      ctx.globalAlpha = 1;
      ctx.strokeStyle = colours.force;
      ctx.lineWidth = 2 * devicePixelRatio;
    }
    const [begin, end] = this.#kept();
    const x = (i) => x0 + dx * this.#depth[i % KEPT];
    const y = (i) => y0 + dy * this.#force[i % KEPT];
    if (end > this.#drawn) {
      ctx.beginPath();
      for (let i = Math.max(begin, this.#drawn - 1); i < end; i++) ctx.lineTo(x(i), y(i));
      ctx.stroke();
      this.#drawn = end;
    }
    u.ctx.save(); // uPlot keeps in mind what it has set
    u.ctx.beginPath();
    u.ctx.rect(left, top, width, height);
    u.ctx.clip();
    u.ctx.drawImage(this.#layer, left, top);
    if (end > begin) {
      u.ctx.beginPath();
      u.ctx.arc(left + x(end - 1), top + y(end - 1), 5 * devicePixelRatio, 0, 7);
      u.ctx.fillStyle = colours.force;
      u.ctx.fill();
    }
    u.ctx.restore();
  }
}
