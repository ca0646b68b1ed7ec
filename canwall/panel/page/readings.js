// What the run says about itself, as text.

import { digits, fixed, known, seconds } from "./numbers.js";

const at = (id) => document.getElementById(id);

/** Set a text only if it is another: the browser composes the page anew for each that is set. */
export function setText(place, text) {
  if (place.textContent !== text) place.textContent = text;
}

const say = (id, text) => setText(at(id), text);

/** The large values below the drawing. */
export function showKeyValues({ y, force, stiffness, radius }) {
  say("k-force", fixed(force, 2));
  say("k-depth", known(y) ? fixed(Math.max(-1e3 * y, 0), 1) : "–");
  say("k-stiffness", digits(stiffness, 3));
  say("k-force-at-handle", radius ? `${fixed(force / radius, 1)} N at the handle` : "");
  say("k-depth-at-handle", radius ? `${fixed(Math.max(-1e3 * y * radius, 0), 2)} mm at the handle` : "");
}

function spread(value, unit, relative) {
  const text = `${digits(value, 3)} ${unit}`;
  return known(value) && known(relative) && relative > 0 ? `${text} ± ${fixed(100 * relative, 0)} %` : known(value) ? text : "–";
}

/** The lamp; nothing is known without a run. */
export function showChatter({ chatter, chatter_hz: frequency, felt_ripple_n: ripple }) {
  at("lamp").dataset.on = chatter ?? "unknown";
  const words = known(frequency) && frequency >= 1 ? `${fixed(frequency, 0)} Hz` : "chatter";
  say("k-chatter", chatter === undefined ? "–" : chatter ? words : "quiet");
  say("k-ripple", `felt ripple ${known(ripple) ? `${digits(ripple, 2)} N` : "–"}`);
}

/** All that comes with the status. */
export function showStatus(status) {
  showChatter(status);
  say("f-mass", spread(1e6 * status.mass_kg_m2, "kg·mm²", status.mass_spread));
  say("f-damping", spread(status.hand_damping_nm_s_per_rad, "N·m·s/rad", status.hand_damping_spread));
  say("f-hand", spread(status.hand_stiffness_nm_per_rad, "N·m/rad", status.hand_stiffness_spread));
  say("f-delay", known(status.delay_cycles) ? `${fixed(status.delay_cycles, 2)} cycles` : "–");

  const factor = status.guard_factor;
  say("f-guard", !known(factor) ? "–" : factor >= 1 ? "full force" : `force × ${fixed(factor, 2)}`);
  at("f-guard").dataset.warn = known(factor) && factor < 1;
  say("f-alarms", String(status.guard_alarms ?? "–"));
  say("f-lowest", fixed(status.guard_lowest, 2));

  say("f-margin", status.real_time === false ? "simulated time" : `margin ${seconds(status.margin_s)}`);
  at("f-margin").dataset.warn = status.real_time !== false && known(status.margin_s) && status.margin_s <= 0;
  say("f-p50", `${seconds(status.latency_p50_s)} / ${seconds(status.latency_p99_s)}`);
  say("f-p999", `${seconds(status.latency_p999_s)} / ${seconds(status.latency_max_s)}`);
  say("f-sync", seconds(status.sync_interval_max_s));
  say("f-missed", `${status.missed_tpdo ?? "–"} / ${status.late_rpdo ?? "–"}`);

  const [state, statusword] = (status.drive_state || "–").split(" (");
  say("f-drive", state.toLowerCase());
  say("f-statusword", statusword?.replace("statusword ", "").replace(")", "") ?? "–");
  const code = status.emcy_code;
  say("f-emcy", code ? `0x${code.toString(16).toUpperCase().padStart(4, "0")} ${status.emcy ?? ""}` : "none");
  at("f-emcy").dataset.warn = Boolean(code);
  say("f-beat", status.beat_timeout_s > 0 ? `watched, ${seconds(status.beat_timeout_s)}` : "not watched");
  showGauges(status.limits ?? []);
}

const LABELS = {
  torque_nm: "torque", torque_rate_nm_per_s: "torque rate", speed_rad_s: "speed", position_rad: "position", energy_j: "energy of a contact",
};
const gauges = new Map();

function showGauges(limits) {
  const list = at("gauges");
  for (const { name, unit, bound, used } of limits) {
    const label = LABELS[name] ?? name;
    if (!gauges.has(name)) {
      const item = document.createElement("li");
      const text = document.createElement("span");
      const bar = document.createElement("span");
      bar.className = "gauge";
      bar.setAttribute("role", "meter");
      bar.setAttribute("aria-valuemin", "0");
      bar.setAttribute("aria-valuemax", "100");
      bar.append(document.createElement("i"));
      const value = document.createElement("span");
      item.append(text, bar, value);
      list.append(item);
      gauges.set(name, { text, bar, fill: bar.firstChild, value });
    }
    const gauge = gauges.get(name);
    const share = known(used) ? Math.max(used, 0) : 0;
    gauge.text.textContent = label;
    gauge.bar.setAttribute("aria-label", label);
    gauge.bar.setAttribute("aria-valuenow", Math.round(Math.min(share, 1) * 100));
    gauge.bar.dataset.high = share > 0.8;
    gauge.fill.style.transform = `scaleX(${Math.min(share, 1)})`;
    gauge.value.textContent = `${fixed(100 * share, 0)} % of ${digits(bound, 3)} ${unit}`;
  }
}

/** What an event brought, in a few words: { law: "damped", limits: { torque_nm: 1 } } → law damped, torque 1. */
function details(event) {
  const { cycle, t_s, what, text, ...keys } = event;
  const pairs = Object.entries(keys).flatMap(([key, value]) => (
    value && typeof value === "object" && !Array.isArray(value) ? Object.entries(value) : [[key, value]]
  ));
  return pairs
    .filter(([key, value]) => !(key === "deadbeat" && !value) && !Array.isArray(value))
    .map(([key, value]) => `${key.replace(/_(nm|rad|j|s)(_.*)?$/, "").replaceAll("_", " ")} ${String(value).replaceAll("_", " ")}`)
    .join(", ");
}

/** The text of a mark; a blind comparison notes its trials as JSON. */
function ofMark(text) {
  if (!text.startsWith('{"blind":')) return text;
  const { blind, trial, answer, reason } = JSON.parse(text);
  if (reason !== undefined) return `blind comparison: ${reason}`;
  if (trial === undefined) return `blind ${blind} begins`;
  return answer === undefined ? `trial ${trial}` : `trial ${trial}: answered`;
}

/** The latest marks, newest first. */
export function showMarks(marks) {
  const shown = marks.slice(-6).reverse().map((event) => {
    const item = document.createElement("li");
    const time = document.createElement("span");
    time.className = "muted";
    time.textContent = `${fixed(event.t_s, 1)} s`;
    const what = event.what === "mark" ? ofMark(event.text) : event.what === "change" ? "" : event.what.replaceAll("_", " ");
    const words = document.createElement("span");
    words.textContent = [what, details(event)].filter(Boolean).join(": ");
    item.append(time, words);
    return item;
  });
  if (!shown.length) {
    const item = document.createElement("li");
    item.className = "muted";
    item.textContent = "none yet";
    shown.push(item);
  }
  at("marks").replaceChildren(...shown);
}
