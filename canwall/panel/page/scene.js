// The drawing: the handle on its axis with the wall, and the contact magnified.

import { hatch } from "./hatch.js";
import { COLUMNS } from "./link.js";
import { CalmRange, digits, fixed, known, nice } from "./numbers.js";
import { colours, onTheme, reducedMotion } from "./theme.js";

const Y = COLUMNS.indexOf("y");
const FORCE = COLUMNS.indexOf("force");
const WALL = COLUMNS.indexOf("wall_position");
const TRAIL_S = 1.2;
const SWING = 0.55; // angle that the largest position is drawn with [rad]

export class Scene {
  #depths = new CalmRange(4);
  #angles = new CalmRange(0.05);
  #forces = new CalmRange(0.05);

  constructor(canvas, history) {
    this.canvas = canvas;
    this.history = history;
    this.side = "below";
    this.running = false; // after a run the handle stays where it was, without a force
    onTheme(() => this.draw(performance.now()));
    new ResizeObserver(() => {
      const { clientWidth, clientHeight } = canvas.parentElement;
      canvas.width = Math.round(clientWidth * devicePixelRatio);
      canvas.height = Math.round(clientHeight * devicePixelRatio);
      this.draw(performance.now());
    }).observe(canvas.parentElement);
  }

  draw(milliseconds) {
    const { canvas, history } = this;
    const ctx = canvas.getContext("2d");
    const width = canvas.width / devicePixelRatio;
    const height = canvas.height / devicePixelRatio;
    if (!width || !height || !colours.text) return;
    ctx.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    ctx.lineCap = ctx.lineJoin = "round";
    const now = {
      low: history.lowest(Y),
      high: history.highest(Y),
      force: this.running ? (history.lowest(FORCE) + history.highest(FORCE)) / 2 : NaN,
      wall: history.highest(WALL),
    };
    now.y = (now.low + now.high) / 2;
    let deepest = 0;
    let strongest = 0;
    let farthest = Math.abs(now.wall) || 0;
    const [begin, end] = history.since((history.now || 0) - 4);
    const sign = this.side === "above" ? -1 : 1;
    for (let i = begin; i < end; i++) {
      deepest = Math.min(deepest, history.low[Y][i]);
      strongest = Math.max(strongest, history.high[FORCE][i]);
      farthest = Math.max(farthest, Math.abs(history.high[WALL][i] + sign * history.high[Y][i]));
    }
    now.depth = this.#depths.take(-1e3 * deepest, milliseconds);
    now.swing = this.#angles.take(farthest, milliseconds);
    now.reach = this.#forces.take(strongest, milliseconds);
    if (width >= 560) {
      const share = Math.min(0.4 * width, 1.15 * height);
      this.#axis(ctx, now, 0, 0, share, height);
      this.#lens(ctx, now, share + 12, 12, width - share - 24, height - 24);
    } else {
      const share = 0.42 * height;
      this.#axis(ctx, now, 0, 0, width, share);
      this.#lens(ctx, now, 12, share, width - 24, height - share - 12);
    }
  }

  /** The axis with its handle, and the wall as a sector; angles are drawn larger than they are. */
  #axis(ctx, now, left, top, width, height) {
    const sign = this.side === "above" ? -1 : 1;
    const gain = Math.max(1, SWING / now.swing);
    const wall = known(now.wall) ? now.wall : 0;
    const position = known(now.y) ? wall + sign * now.y : wall;
    const reach = Math.min((width - 40) / 1.16, height * 0.84);
    const x = left + 20 + (width - 40 - 1.16 * reach) / 2 + 0.16 * reach;
    const y = top + height / 2 - sign * 0.08 * height;
    const face = -gain * wall; // canvas: y points down
    const lever = -gain * position;
    ctx.save();
    // wall
    ctx.beginPath();
    ctx.arc(x, y, reach * 1.0, face, face + sign * 0.5, sign < 0);
    ctx.arc(x, y, reach * 0.52, face + sign * 0.5, face, sign > 0);
    ctx.closePath();
    ctx.save();
    ctx.clip();
    hatch(ctx, x, y - reach, reach, 2 * reach);
    ctx.restore();
    ctx.strokeStyle = colours["wall-edge"];
    ctx.lineWidth = 4;
    ctx.beginPath();
    ctx.moveTo(x + reach * 0.52 * Math.cos(face), y + reach * 0.52 * Math.sin(face));
    ctx.lineTo(x + reach * 1.0 * Math.cos(face), y + reach * 1.0 * Math.sin(face));
    ctx.stroke();
    // handle: lever and knob, above the wall's face by the knob's radius
    const knob = Math.max(11, reach * 0.07);
    ctx.translate(x, y);
    ctx.rotate(lever);
    ctx.strokeStyle = colours.handle;
    ctx.lineWidth = Math.max(9, reach * 0.055);
    ctx.beginPath();
    ctx.moveTo(0, -sign * knob);
    ctx.lineTo(reach * 0.76, -sign * knob);
    ctx.stroke();
    ctx.fillStyle = colours.handle;
    ctx.beginPath();
    ctx.arc(reach * 0.76, -sign * knob, knob, 0, 7);
    ctx.fill();
    ctx.fillStyle = colours.surface;
    ctx.beginPath();
    ctx.arc(reach * 0.76, -sign * knob, knob * 0.42, 0, 7);
    ctx.fill();
    this.#arrow(ctx, now.force / now.reach, reach * 0.76, -sign * 2.4 * knob, -sign, reach * 0.4, 0.05 * reach);
    ctx.restore();
    // hub
    ctx.fillStyle = colours.raised;
    ctx.strokeStyle = colours.handle;
    ctx.lineWidth = 4;
    ctx.beginPath();
    ctx.arc(x, y - sign * knob, reach * 0.13, 0, 7);
    ctx.fill();
    ctx.stroke();
    ctx.fillStyle = colours.handle;
    ctx.beginPath();
    ctx.arc(x, y - sign * knob, reach * 0.03, 0, 7);
    ctx.fill();
    label(ctx, gain > 1.05 ? `angle × ${digits(gain, 2)}` : "true angle", left + 16, top + height - 16, 15, colours.muted);
  }

  /** The contact under the magnifying glass, with the way that the handle has just gone. */
  #lens(ctx, now, left, top, width, height) {
    const surface = top + 0.42 * height;
    const scale = (0.5 * height) / now.depth; // pixels per mrad
    const tip = left + Math.max(0.26 * width, 64);
    // Below the surface to scale; above it the way is compressed, so that the handle stays in view.
    const above = 0.26 * height;
    const level = (y) => surface - (y > 0 ? above * Math.tanh((1e3 * y * scale) / above) : 1e3 * y * scale);
    ctx.save();
    ctx.beginPath();
    ctx.roundRect(left, top, width, height, 16);
    ctx.fillStyle = colours.raised;
    ctx.fill();
    ctx.clip();
    hatch(ctx, left, surface, width, top + height - surface);
    ctx.strokeStyle = colours["wall-edge"];
    ctx.lineWidth = 3;
    ctx.beginPath();
    ctx.moveTo(left, surface);
    ctx.lineTo(left + width, surface);
    ctx.stroke();
    if (!reducedMotion()) this.#trail(ctx, tip, left + width, level);
    if (known(now.y)) {
      const radius = Math.min(0.29 * height, 0.2 * width);
      const bottom = level(now.y);
      // where the handle was within the latest point: seen if it buzzes
      ctx.fillStyle = colours.handle;
      ctx.globalAlpha = 0.25;
      ctx.beginPath();
      ctx.arc(tip, level(now.low) - radius, radius, 0, 7);
      ctx.arc(tip, level(now.high) - radius, radius, 0, 7);
      ctx.fill();
      ctx.globalAlpha = 1;
      ctx.fillStyle = colours.surface;
      ctx.strokeStyle = colours.handle;
      ctx.lineWidth = 0.2 * radius;
      ctx.beginPath();
      ctx.arc(tip, bottom - radius, 0.9 * radius, 0, 7);
      ctx.fill();
      ctx.stroke();
      if (now.y < 0 && bottom - surface > 6) {
        // the penetration, between the surface and the handle's lowest point
        const x = tip - radius - 18;
        ctx.strokeStyle = colours.text;
        ctx.lineWidth = 2;
        ctx.beginPath();
        ctx.moveTo(x - 7, surface);
        ctx.lineTo(x + 7, surface);
        ctx.moveTo(x, surface);
        ctx.lineTo(x, bottom);
        ctx.moveTo(x - 7, bottom);
        ctx.lineTo(tip, bottom);
        ctx.stroke();
      }
      if (this.#arrow(ctx, now.force / now.reach, tip, bottom, -1, bottom - top - 16, 0.2 * radius)) {
        const y = Math.max(bottom - radius, top + 30) + 8;
        label(ctx, `${fixed(now.force, 2)} N·m`, tip + radius + 16, y, 24, colours.text, 700, colours.raised);
      }
    }
    // scale
    const bar = nice(now.depth / 4);
    const x = left + width - 20;
    const y = top + height - 18;
    ctx.strokeStyle = colours.text;
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(x - 6, y);
    ctx.lineTo(x + 6, y);
    ctx.moveTo(x, y);
    ctx.lineTo(x, y - bar * scale);
    ctx.moveTo(x - 6, y - bar * scale);
    ctx.lineTo(x + 6, y - bar * scale);
    ctx.stroke();
    ctx.textAlign = "right";
    label(ctx, `${digits(bar, 1)} mrad`, x - 14, y - (bar * scale) / 2 + 5, 15, colours.text, 600);
    ctx.textAlign = "left";
    ctx.restore();
  }

  #trail(ctx, from, to, level) {
    const { history } = this;
    const [begin, end] = history.since((history.now || 0) - TRAIL_S);
    if (end - begin < 2) return;
    const x = (i) => from + ((history.now - history.t[i]) / TRAIL_S) * (to - from);
    ctx.beginPath();
    for (let i = end - 1; i >= begin; i--) ctx.lineTo(x(i), level(history.high[Y][i]));
    for (let i = begin; i < end; i++) ctx.lineTo(x(i), level(history.low[Y][i]));
    ctx.closePath();
    ctx.strokeStyle = ctx.fillStyle = colours.position;
    ctx.lineWidth = 3;
    ctx.stroke();
    ctx.fill();
  }

  /** An arrow as long as the force's part of the largest one of late; returns the length. */
  #arrow(ctx, share, x, y, direction, longest, width) {
    const length = Math.min(Math.abs(share), 1) * longest;
    if (!(length > 3)) return 0;
    const towards = direction * Math.sign(share);
    const head = Math.min(2.2 * width, length);
    ctx.fillStyle = colours.force;
    ctx.strokeStyle = colours.surface;
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(x - width / 2, y);
    ctx.lineTo(x - width / 2, y + towards * (length - head));
    ctx.lineTo(x - 1.3 * width, y + towards * (length - head));
    ctx.lineTo(x, y + towards * length);
    ctx.lineTo(x + 1.3 * width, y + towards * (length - head));
    ctx.lineTo(x + width / 2, y + towards * (length - head));
    ctx.lineTo(x + width / 2, y);
    ctx.closePath();
    ctx.stroke();
    ctx.fill();
    return length;
  }
}

function label(ctx, text, x, y, size, colour, weight = 400, halo = null) {
  ctx.font = `${weight} ${size}px system-ui, "Segoe UI", Roboto, "Noto Sans", sans-serif`;
  if (halo) {
    ctx.strokeStyle = halo;
    ctx.lineWidth = 6;
    ctx.strokeText(text, x, y);
  }
  ctx.fillStyle = colour;
  ctx.fillText(text, x, y);
}
