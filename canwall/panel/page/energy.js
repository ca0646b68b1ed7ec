// Energy that the wall put out in each contact, as bars: passive or not by colour and shape.

import { joules } from "./numbers.js";

const NS = "http://www.w3.org/2000/svg";
const SHOWN = 12;
const HEIGHT = 200;
const TALLEST = 118; // of the longest bars up and down together

function shape(name, attributes, text) {
  const made = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

/** Draw the latest contacts into a place. */
export function drawEnergy(place, contacts) {
  const width = place.clientWidth || 600;
  const shown = contacts.slice(-Math.min(SHOWN, Math.floor(width / 64)));
  const svg = shape("svg", { width, height: HEIGHT, "aria-hidden": "true" });
  const hatch = shape("pattern", { id: "hatch", width: 8, height: 8, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" });
  hatch.append(
    shape("rect", { width: 8, height: 8, class: "bar-active" }),
    shape("rect", { width: 3, height: 8, class: "bar-hatch" }),
  );
  svg.append(hatch);
  const most = Math.max(...shown.map((each) => each.energy_j ?? 0), 0);
  const least = Math.min(...shown.map((each) => each.energy_j ?? 0), 0);
  const scale = TALLEST / Math.max(most - least, 1e-9);
  const zero = 40 + most * scale ;
  const slot = width / Math.min(SHOWN, Math.floor(width / 64));
  shown.forEach(({ n, energy_j: energy, passive, law, stiffness, peak_force_nm: peak }, i) => {
    const height = Math.max(Math.abs(energy) * scale, 2);
    const x = i * slot + 7;
    const up = energy > 0;
    const y = up ? zero - height : zero;
    const bar = shape("rect", {
      x, y, width: slot - 14, height, rx: 2,
      ...(passive ? { class: "bar-passive" } : { fill: "url(#hatch)", class: "bar-edge" }),
    });
    bar.append(shape("title", {}, [
      `contact ${n}: ${joules(energy)}`, law, stiffness && `${stiffness.toPrecision(3)} N·m/rad`,
      peak && `peak ${peak.toPrecision(3)} N·m`,
    ].filter(Boolean).join(", ")));
    svg.append(bar);
    const middle = x + (slot - 14) / 2;
    if (!passive) {
      const tip = y - 17;
      svg.append(shape("path", { d: `M${middle} ${tip}l8 13h-16z`, class: "bar-active" }));
    }
    const beside = up ? y - (passive ? 6 : 21) : y + height + 14;
    svg.append(shape("text", { x: middle, y: beside, class: "bar-text" }, joules(energy)));
    svg.append(shape("text", { x: middle, y: HEIGHT - 4, class: "bar-number" }, n));
  });
  svg.append(shape("path", { d: `M0 ${zero}H${width}`, class: "bar-zero" }));
  place.replaceChildren(svg);
  const bad = shown.filter((each) => !each.passive).length;
  place.setAttribute("aria-label", shown.length
    ? `The last ${shown.length} contacts: ${bad} not passive; the latest ${joules(shown.at(-1).energy_j)}`
    : "No contact yet");
}
