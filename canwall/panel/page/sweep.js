// A sweep as a map of walls, quiet or not; a point of it shows its strike, simulated again.

import { COLUMNS, signals } from "./link.js";
import { digits, known } from "./numbers.js";
import { Plot, bandOptions, decimals } from "./plots.js";
import { colours, onTheme } from "./theme.js";

const at = (id) => document.getElementById(id);
const LEFT = 84;
const BELOW = 58;
const ABOVE = 12;
const RIGHT = 16;

/** Plot of a strike and, dashed, of its continuous referent. */
class StrikePlot {
  constructor(place, { column, referent, colour, factor = 1, labels = true }) {
    Object.assign(this, { column, referent, factor });
    this.range = [-1, 1];
    const band = bandOptions({
      bands: [{ colour }, { colour: "referent", dash: [8, 6] }],
      column,
      scales: { y: { range: () => this.range } },
      labels,
      decimals,
      time: (t) => `${digits(1e3 * t, 3)} ms`,
    });
    this.plot = new Plot(place, band, [[], [], [], [], []]);
  }

  draw({ t, low, high }, names) {
    const series = [this.column, this.referent].flatMap((name) => {
      const index = names.indexOf(name);
      return [low[index], high[index]].map((each) => each.map((value) => value * this.factor));
    });
    let least = 0;
    let most = 0;
    for (const each of series) {
      for (const value of each) {
        least = Math.min(least, known(value) ? value : 0);
        most = Math.max(most, known(value) ? value : 0);
      }
    }
    const margin = 0.08 * (most - least) || 1;
    this.range = [least - margin, most + margin];
    this.plot.draw([t, ...series]);
  }
}

export class SweepMap {
  #map = null;
  #chosen = {};
  #at = [0, 0]; // index on the axes x and y

  constructor() {
    this.canvas = at("sweep");
    this.plots = [
      new StrikePlot(at("strike-position"), { column: "y", referent: "referent_y", colour: "position", factor: 1e3, labels: false }),
      new StrikePlot(at("strike-force"), { column: "felt", referent: "referent_felt", colour: "force" }),
    ];
    onTheme(() => this.#draw());
    new ResizeObserver(() => {
      const { clientWidth, clientHeight } = this.canvas.parentElement;
      this.canvas.width = Math.round(clientWidth * devicePixelRatio);
      this.canvas.height = Math.round(clientHeight * devicePixelRatio);
      this.#draw();
    }).observe(this.canvas.parentElement);
    this.canvas.addEventListener("click", (event) => {
      const cell = this.#cellAt(event.offsetX, event.offsetY);
      if (!cell) return;
      this.#at = cell;
      this.#draw();
      this.#strike();
    });
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (step) {
        event.preventDefault();
        const [columns, rows] = this.#size();
        this.#at = [
          Math.min(Math.max(this.#at[0] + step[0], 0), columns - 1),
          Math.min(Math.max(this.#at[1] + step[1], 0), rows - 1),
        ];
        this.#say();
        this.#draw();
      } else if (event.key === "Enter") this.#strike();
    });
  }

  async open({ id, name }) {
    this.id = id;
    this.#chosen = {};
    this.#at = [0, 0];
    at("sweep-title").textContent = name;
    at("strike-place").hidden = true;
    await this.#load();
  }

  async #load() {
    const query = new URLSearchParams(this.#conditions()).toString();
    const answer = await fetch(`/api/sweep/${this.id}?${query}`);
    const content = await answer.json();
    if (!answer.ok) {
      at("sweep-text").textContent = content.error;
      return;
    }
    this.#map = content;
    this.#choices();
    this.#say();
    this.#draw();
  }

  /** What is chosen on the axes that are neither of the map nor of the strike. */
  #conditions() {
    const strike = this.#map?.strike_axes ?? [];
    return Object.fromEntries(Object.entries(this.#chosen).filter(([name]) => !strike.includes(name)));
  }

  #axis(name) {
    return this.#map.axes.find((each) => each.name === name);
  }

  #size() {
    const y = this.#map.y && this.#axis(this.#map.y);
    return [this.#axis(this.#map.x).values.length, y ? y.values.length : 1];
  }

  #choices() {
    const { axes, x, y } = this.#map;
    at("sweep-choices").replaceChildren(...axes.filter(({ name, values }) => name !== x && name !== y && values.length > 1).map(({ name, label, unit, shown, values }) => {
      const whole = document.createElement("label");
      const select = document.createElement("select");
      select.append(...(shown ?? values).map((text, i) => new Option(`${text}`.replaceAll("_", " "), i)));
      select.value = this.#chosen[name] ?? 0;
      select.addEventListener("change", () => {
        this.#chosen[name] = Number(select.value);
        if (this.#map.strike_axes?.includes(name)) this.#strike();
        else this.#load();
      });
      whole.append(`${label}${unit ? ` [${unit}]` : ""} `, select);
      return whole;
    }));
  }

  #say() {
    const { x, y, chatters, worst } = this.#map;
    const [i, j] = this.#at;
    const words = [x, y].filter(Boolean).map((name, k) => {
      const { label, unit, values } = this.#axis(name);
      return `${label} ${digits(values[this.#at[k]])} ${unit ?? ""}`.trim();
    });
    words.push(chatters ? (chatters[j][i] ? "▲ chatters" : "quiet") : `quiet up to ${digits(worst?.[i])} N·m/rad`);
    at("sweep-text").textContent = `${words.join(", ")}. Click, or press Enter, to see a strike.`;
  }

  #box() {
    const width = this.canvas.width / devicePixelRatio - LEFT - RIGHT;
    const height = this.canvas.height / devicePixelRatio - BELOW - ABOVE;
    const [columns, rows] = this.#size();
    return { width, height, columns, rows, dx: width / columns, dy: height / rows };
  }

  #cellAt(x, y) {
    if (!this.#map) return null;
    const { columns, rows, dx, dy, height } = this.#box();
    const i = Math.floor((x - LEFT) / dx);
    const j = Math.floor((ABOVE + height - y) / dy);
    return i >= 0 && j >= 0 && i < columns && j < rows ? [i, j] : null;
  }

  #draw() {
    const ctx = this.canvas.getContext("2d");
    ctx.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (!this.#map || !this.canvas.width) return;
    const { x, y, chatters, worst, limits = [] } = this.#map;
    const { width, height, columns, rows, dx, dy } = this.#box();
    const most = worst ? Math.max(...worst.filter(known), 1e-9) : 1;
    ctx.strokeStyle = colours.active;
    for (let i = 0; i < columns; i++) {
      for (let j = 0; j < rows; j++) {
        const left = LEFT + i * dx;
        const share = worst ? (worst[i] ?? 0) / most : 1;
        const top = ABOVE + height - j * dy - dy * share;
        const bad = chatters?.[j]?.[i];
        ctx.fillStyle = bad ? colours["chatter-area"] : colours["quiet-area"];
        ctx.fillRect(left, top, dx - (dx > 6 ? 1 : 0), dy * share - (dy > 6 ? 1 : 0));
        if (bad && dx > 7 && dy > 7) {
          const size = Math.min(dx, dy, 22) * 0.22;
          ctx.fillStyle = colours.active;
          ctx.beginPath();
          ctx.moveTo(left + dx / 2, top + dy / 2 - size);
          ctx.lineTo(left + dx / 2 + size, top + dy / 2 + size);
          ctx.lineTo(left + dx / 2 - size, top + dy / 2 + size);
          ctx.fill();
        }
      }
    }
    // Columns and rows as the axis goes on beyond them; NaN outside the map.
    const place = (name, value, count) => {
      const { values } = this.#axis(name);
      if (values.length < 2) return NaN;
      const beyond = value > values.at(-1);
      const k = beyond ? values.length - 1 : Math.max(values.findIndex((each) => each >= value), 1);
      const [from, to] = [values[k - 1], values[k]];
      const along = Math.abs(values[2] / values[1] - values[1] / values[0]) < 1e-3
        ? Math.log(value / from) / Math.log(to / from)
        : (value - from) / (to - from);
      const found = k - 0.5 + along;
      return found >= 0 && found <= count ? found : NaN;
    };
    ctx.save();
    ctx.beginPath();
    ctx.rect(LEFT, ABOVE, width, height);
    ctx.clip();
    limits.forEach(({ x: along, y: up, label: words }, k) => {
      ctx.strokeStyle = colours.referent;
      ctx.lineWidth = 2.5;
      ctx.setLineDash([[], [9, 5], [3, 4], [12, 4, 3, 4]][k % 4]);
      ctx.beginPath();
      let drawing = false;
      along.forEach((value, n) => {
        const [i, j] = [place(x, value, columns), place(y, up[n], rows)];
        if (!known(i) || !known(j)) drawing = false;
        else if (drawing) ctx.lineTo(LEFT + i * dx, ABOVE + height - j * dy);
        else ctx.moveTo(LEFT + i * dx, ABOVE + height - j * dy);
        drawing = known(i) && known(j);
      });
      const level = ABOVE + 20 + 18 * k;
      ctx.stroke();
      ctx.moveTo(LEFT + 10, level - 4);
      ctx.lineTo(LEFT + 44, level - 4);
      ctx.stroke();
      ctx.font = "600 13px system-ui, sans-serif";
      ctx.fillStyle = colours.text;
      ctx.fillText(words, LEFT + 52, level);
    });
    ctx.restore();
    ctx.setLineDash([]);
    ctx.strokeStyle = colours.text;
    ctx.lineWidth = 3;
    ctx.strokeRect(LEFT + this.#at[0] * dx, ABOVE + height - (this.#at[1] + 1) * dy, dx, dy);
    ctx.font = "13px system-ui, sans-serif";
    ctx.fillStyle = colours.muted;
    this.#ticks(ctx, this.#axis(x), columns, dx, (text, k) => {
      ctx.textAlign = "center";
      ctx.fillText(text, LEFT + (k + 0.5) * dx, ABOVE + height + 20);
    }, 56);
    ctx.textAlign = "center";
    ctx.fillText(named(this.#axis(x)), LEFT + width / 2, ABOVE + height + 46);
    if (y) {
      this.#ticks(ctx, this.#axis(y), rows, dy, (text, k) => {
        ctx.textAlign = "right";
        ctx.fillText(text, LEFT - 8, ABOVE + height - (k + 0.5) * dy + 4);
      }, 24);
    } else {
      ctx.textAlign = "right";
      ctx.fillText(digits(most), LEFT - 8, ABOVE + 10);
      ctx.fillText("0", LEFT - 8, ABOVE + height);
    }
    ctx.save();
    ctx.translate(16, ABOVE + height / 2);
    ctx.rotate(-Math.PI / 2);
    ctx.textAlign = "center";
    ctx.fillText(y ? named(this.#axis(y)) : "largest quiet stiffness [N·m/rad]", 0, 0);
    ctx.restore();
    ctx.textAlign = "left";
  }

  #ticks(ctx, { values }, count, size, draw, least) {
    const stride = Math.ceil(least / size);
    for (let k = 0; k < count; k += stride) draw(digits(values[k], 2), k);
  }

  async #strike() {
    const { x, y } = this.#map;
    const indices = { ...this.#chosen, [x]: this.#at[0], ...(y ? { [y]: this.#at[1] } : {}) };
    at("sweep-text").textContent = "simulating the strike …";
    try {
      const answer = await fetch(`/api/sweep/${this.id}/strike`, {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ indices }),
      });
      if (!answer.ok) throw new Error((await answer.json()).error);
      const whole = await answer.arrayBuffer();
      const length = new DataView(whole).getUint32(0, true);
      const told = JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, length)));
      const frame = signals(whole.slice(4 + length));
      at("strike-place").hidden = false;
      for (const plot of this.plots) plot.draw(frame, told.columns ?? COLUMNS);
      at("sweep-text").textContent = [
        told.title, `stiffness ${digits(told.stiffness)} N·m/rad`, `damping ${digits(told.damping)} N·m·s/rad`,
        told.same === false && "differs from what the sweep has stored",
      ].filter(Boolean).join("; ");
    } catch (error) {
      at("sweep-text").textContent = error.message;
    }
  }
}

function named({ label, unit }) {
  return unit ? `${label} [${unit}]` : label;
}
