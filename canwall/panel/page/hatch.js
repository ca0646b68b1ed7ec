// The wall's inside: one tile of it, drawn once a theme.

import { colours, onTheme } from "./theme.js";

const STEP = 14; // between two lines [pixels of the screen]

let tile = null;
onTheme(() => { tile = null; });

function makeTile() {
  tile = new OffscreenCanvas(STEP, STEP);
  const ctx = tile.getContext("2d");
  ctx.fillStyle = colours.wall;
  ctx.fillRect(0, 0, STEP, STEP);
  ctx.strokeStyle = colours["wall-edge"];
  ctx.globalAlpha = 0.35;
  ctx.lineWidth = 1.2;
  ctx.beginPath();
  for (const x of [-STEP, 0, STEP]) {
    ctx.moveTo(x, STEP);
    ctx.lineTo(x + STEP, 0);
  }
  ctx.stroke();
}

/** Fill a rectangle with the wall's inside; the lines stay with its corner. */
export function hatch(ctx, left, top, width, height) {
  if (!tile) makeTile();
  const pattern = ctx.createPattern(tile, "repeat");
  const scale = 1 / ctx.getTransform().a;
  pattern.setTransform(new DOMMatrix([scale, 0, 0, scale, left, top]));
  ctx.fillStyle = pattern;
  ctx.fillRect(left, top, width, height);
}
