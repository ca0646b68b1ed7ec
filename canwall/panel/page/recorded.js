// Recorded runs: a list, one of them opened at any zoom, a second one for comparison.

import { COLUMNS, signals } from "./link.js";
import { digits, fixed, joules, known } from "./numbers.js";
import { Plot, bandOptions, decimals, outline } from "./plots.js";
import { SweepMap } from "./sweep.js";
import { define, table } from "./tables.js";
import { colours } from "./theme.js";

const at = (id) => document.getElementById(id);
const LEAST_S = 0.004;

/** Plot of a column of the opened run and, if there is one, of the run it is compared with. */
class RecordedPlot {
  constructor(place, view, { column, colour, factor = 1, labels = true, zero = true }) {
    Object.assign(this, { view, column: COLUMNS.indexOf(column), factor, zero });
    this.range = [-1, 1];
    this.plot = new Plot(place, bandOptions({
      bands: [{ colour }],
      column,
      scales: { x: { range: () => [view.from, view.to] }, y: { range: () => this.range } },
      labels,
      decimals,
      time: (t) => `${digits(t, 5).replace(/\.?0+$/, "") || 0} s`,
      cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false },
      hooks: {
        setSelect: [(u) => {
          const { left, width } = u.select;
          if (width > 4) view.show(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        }],
        ready: [(u) => u.over.addEventListener("dblclick", () => view.show(0, view.duration))],
        draw: [(u) => {
          if (view.other) drawBand(u, view.other, this.column, this.factor, view.shift);
          for (const { t_s: t } of view.marks) drawMark(u, t);
        }],
      },
    }), [[], [], []]);
  }

  draw({ t, low, high }) {
    const scaled = [low[this.column], high[this.column]].map((each) => each.map((value) => value * this.factor));
    const others = this.view.other ? [this.view.other.low, this.view.other.high].flatMap((each) => [each[this.column]]) : [];
    let least = this.zero ? 0 : Infinity;
    let most = this.zero ? 0 : -Infinity;
    const widen = (value) => {
      if (value < least) least = value;
      if (value > most) most = value;
    };
    for (const each of scaled) each.forEach(widen);
    for (const each of others) each.forEach((value) => widen(value * this.factor));
    const margin = 0.08 * (most - least) || 1;
    this.range = [least - margin, most + margin];
    this.plot.draw([t, ...scaled]);
  }
}

function drawBand(u, { t, low, high }, column, factor, shift) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.strokeStyle = ctx.fillStyle = colours.active;
  ctx.lineWidth = 1.5 * devicePixelRatio;
  ctx.setLineDash([7 * devicePixelRatio, 4 * devicePixelRatio]);
  const paths = outline(u, { t, low: low[column], high: high[column] }, { dashed: true, shift, factor });
  ctx.stroke(paths.stroke);
  ctx.globalAlpha = 0.3;
  ctx.fill(paths.fill);
  ctx.restore();
}

function drawMark(u, t) {
  const { ctx, bbox } = u;
  const x = u.valToPos(t, "x", true);
  if (!(x >= bbox.left && x <= bbox.left + bbox.width)) return;
  ctx.save();
  ctx.strokeStyle = colours.muted;
  ctx.setLineDash([2 * devicePixelRatio, 4 * devicePixelRatio]);
  ctx.beginPath();
  ctx.moveTo(x, bbox.top);
  ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.restore();
}

async function json(address) {
  const answer = await fetch(address);
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error ?? answer.statusText);
  return content;
}

export class Recorded {
  #items = [];
  #run = null;
  #second = null;
  #asking = null;

  constructor() {
    Object.assign(this, { from: 0, to: 1, duration: 1, marks: [], other: null, shift: 0 });
    this.plots = [
      new RecordedPlot(at("rec-position"), this, { column: "y", colour: "position", factor: 1e3, labels: false }),
      new RecordedPlot(at("rec-force"), this, { column: "force", colour: "force", labels: false }),
      new RecordedPlot(at("rec-stiffness"), this, { column: "stiffness_in_force", colour: "command" }),
    ];
    this.sweep = new SweepMap();
    at("reload").addEventListener("click", () => this.begin());
    at("find").addEventListener("input", () => this.#list());
    at("compare").addEventListener("change", () => this.#compare());
    at("align").addEventListener("change", () => this.#fetch());
    for (const button of document.querySelectorAll("[data-zoom]")) {
      button.addEventListener("click", () => {
        const { zoom } = button.dataset;
        if (zoom === "left" || zoom === "right") this.pan(zoom === "left" ? -1 : 1);
        else this.zoom(zoom);
      });
    }
    for (const { plot } of this.plots) {
      plot.place.addEventListener("wheel", (event) => {
        if (!event.ctrlKey && !event.shiftKey) return; // the page scrolls
        event.preventDefault();
        this.zoom(event.deltaY < 0 ? "in" : "out");
      }, { passive: false });
    }
  }

  /** Look for what is recorded, and open what the address says. */
  async begin() {
    try {
      ({ items: this.#items } = await json("/api/recorded"));
    } catch (error) {
      this.#items = [];
      this.#list(error.message);
      return;
    }
    this.#list();
    const id = location.hash.split("/")[1];
    const item = this.#items.find((each) => each.id === id);
    if (item && item.id !== this.#run?.id) this.#open(item);
  }

  zoom(how) {
    if (!this.#run) return;
    if (how === "all") {
      this.show(0, this.duration);
      return;
    }
    const middle = (this.from + this.to) / 2;
    const half = ((this.to - this.from) / 2) * (how === "in" ? 0.5 : 2);
    this.show(middle - half, middle + half);
  }

  pan(direction) {
    if (!this.#run) return;
    const width = this.to - this.from;
    const from = Math.min(Math.max(this.from + direction * 0.25 * width, 0), this.duration - width);
    this.show(from, from + width);
  }

  /** Show from one instant to another: at once with what is there, then at the zoom's resolution. */
  show(from, to) {
    const middle = (from + to) / 2;
    const half = Math.max(to - from, LEAST_S) / 2;
    this.from = Math.max(middle - half, 0);
    this.to = Math.min(middle + half, this.duration);
    at("zoom-text").textContent = `${fixed(this.from, 3)} … ${fixed(this.to, 3)} s`;
    this.#draw();
    this.#fetch();
  }

  #list(trouble) {
    const words = at("find").value.toLowerCase();
    const found = this.#items.filter(({ name, laws = [] }) => `${name} ${laws.join(" ")}`.toLowerCase().includes(words));
    at("items").replaceChildren(...found.map((item) => {
      const line = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      if (item.id === this.#run?.id) button.setAttribute("aria-current", "true");
      const title = document.createElement("strong");
      title.textContent = item.name;
      const text = document.createElement("span");
      text.textContent = describe(item);
      const verdict = document.createElement("span");
      verdict.className = item.chatter ? "verdict active" : "verdict";
      verdict.textContent = item.kind === "sweep" ? "sweep" : item.chatter === true ? "▲ chatter" : item.chatter === false ? "quiet" : item.state ?? "";
      button.append(title, verdict, text);
      button.addEventListener("click", () => {
        const address = `#recorded/${item.id}`;
        if (location.hash === address) this.#open(item); // once more: it may have been in progress
        else location.hash = address;
      });
      line.append(button);
      return line;
    }));
    if (!found.length) {
      const line = document.createElement("li");
      line.className = "muted";
      line.textContent = trouble ?? (this.#items.length ? "nothing of that name" : "nothing recorded below this folder yet");
      at("items").append(line);
    }
  }

  async #open(item) {
    const sweep = item.kind === "sweep";
    at("opened-none").hidden = true;
    at("opened-run").hidden = sweep;
    at("opened-sweep").hidden = !sweep;
    this.#run = item;
    this.#list();
    if (sweep) {
      this.sweep.open(item);
      return;
    }
    at("opened-title").textContent = item.name;
    at("opened-summary").replaceChildren();
    at("strikes").replaceChildren();
    this.#second = this.other = null;
    this.data = null;
    const others = this.#items.filter(({ id, kind }) => kind === "run" && id !== item.id);
    at("compare").replaceChildren(new Option("nothing", ""), ...others.map(({ id, name }) => new Option(name, id)));
    at("compare-legend").hidden = true;
    try {
      this.details = await json(`/api/recorded/${item.id}`);
    } catch (error) {
      at("strikes").textContent = error.message;
      return;
    }
    this.marks = this.details.marks ?? [];
    this.duration = this.details.duration_s ?? item.duration_s ?? 1;
    showSummary(at("opened-summary"), this.details);
    at("strikes").replaceChildren(strikeTable(this.details.strikes ?? []));
    this.show(0, this.duration);
  }

  async #compare() {
    const id = at("compare").value;
    this.#second = this.other = null;
    at("compare-legend").hidden = !id;
    if (id) {
      try {
        this.#second = await json(`/api/recorded/${id}`);
        at("compare-legend").replaceChildren(
          key("key-solid", this.details.name), " ", key("key-compared", this.#second.name),
        );
      } catch (error) {
        at("compare-legend").textContent = error.message;
      }
    }
    this.#fetch();
  }

  async #fetch() {
    if (!this.#run) return;
    this.#asking?.abort();
    this.#asking = new AbortController();
    const { signal } = this.#asking;
    const points = Math.min(Math.max(at("rec-position").clientWidth, 300), 4000);
    const get = async (id, from, to) => {
      const answer = await fetch(`/api/recorded/${id}/signals?from=${from}&to=${to}&points=${points}`, { signal });
      if (!answer.ok) throw new Error((await answer.json()).error);
      return signals(await answer.arrayBuffer());
    };
    try {
      const first = (details) => (at("align").value === "contact" ? details.strikes?.[0]?.start_s ?? 0 : 0);
      this.shift = this.#second ? first(this.details) - first(this.#second) : 0;
      const [data, other] = await Promise.all([
        get(this.#run.id, this.from, this.to),
        this.#second && get(this.#second.id, this.from - this.shift, this.to - this.shift),
      ]);
      this.data = data;
      this.other = other;
      this.#draw();
    } catch (error) {
      if (error.name !== "AbortError") at("zoom-text").textContent = error.message;
    }
  }

  #draw() {
    if (this.data) for (const plot of this.plots) plot.draw(this.data);
  }
}

function key(kind, text) {
  const whole = document.createElement("span");
  whole.className = `key ${kind}`;
  whole.textContent = text;
  return whole;
}

function describe({ when, laws = [], stiffness, strikes, duration_s: duration }) {
  const date = when ? new Date(when).toLocaleString([], { dateStyle: "medium", timeStyle: "short" }) : "";
  return [
    date, laws.map((law) => law.replaceAll("_", " ")).join(", "), known(stiffness) && `${digits(stiffness)} N·m/rad`,
    known(strikes) && `${strikes} strike${strikes === 1 ? "" : "s"}`, known(duration) && `${digits(duration)} s`,
  ].filter(Boolean).join(" · ");
}

function showSummary(place, { when, remarks, remark, summary = {}, duration_s: duration }) {
  define(place, [
    ["When", when && new Date(when).toLocaleString()],
    ["Duration", known(duration) && `${digits(duration)} s`],
    ["Law", [].concat(summary.law ?? []).join(", ").replaceAll("_", " ")],
    ["Chatter", summary.chatter === true ? `▲ ${summary.chatter_reason || "yes"}` : summary.chatter === false && "no"],
    ["Peak torque", known(summary.peak_torque) && `${digits(summary.peak_torque)} N·m`],
    ["Missed TPDOs", summary.missed_tpdo], ["Late RPDOs", summary.late_rpdo],
    ["Remarks", (remarks ?? [remark]).filter(Boolean).join("; ")],
  ]);
}

function strikeTable(strikes) {
  return table(
    ["strike", "from [s]", "to [s]", "law", "stiffness [N·m/rad]", "peak force [N·m]", "depth [mrad]", "energy put out", "passive"],
    strikes.map(({ n, start_s, end_s, law, stiffness, peak_force_nm, depth_rad, energy_j, passive }) => [
      n, start_s, end_s, law, stiffness, peak_force_nm, known(depth_rad) ? 1e3 * Math.abs(depth_rad) : null,
      joules(energy_j), passive === false ? "▲ no" : passive ? "yes" : null,
    ]),
    "Strikes",
  );
}
