// The panel's page: what comes from the server is kept, and drawn 30 times a second.

import { ContactPlot } from "./contact.js";
import { Controls } from "./controls.js";
import { BlindComparison } from "./blind.js";
import { drawEnergy } from "./energy.js";
import { History } from "./history.js";
import { beginKeys, beginTabs } from "./keys.js";
import { COLUMNS, Link } from "./link.js";
import { digits } from "./numbers.js";
import { RollingPlot } from "./plots.js";
import { setText, showChatter, showKeyValues, showMarks, showStatus } from "./readings.js";
import { Recorded } from "./recorded.js";
import { Scene } from "./scene.js";
import { Stop } from "./stop.js";
import { define } from "./tables.js";
import { beginTheme, reducedMotion, toggleTheme } from "./theme.js";

const WINDOW_S = 5;
const CALM_FRAME_MS = 250;
const TEXT_MS = 120;
const CONTACTS = 60;

const at = (id) => document.getElementById(id);
const column = (name) => COLUMNS.indexOf(name);

const link = new Link();
const history = new History(2048, COLUMNS.length);
const stop = new Stop(link, at("stop"), at("stop-state"));
const controls = new Controls(link);
const blind = new BlindComparison(link, controls);
const recorded = new Recorded();
const scene = new Scene(at("scene"), history);
const plots = [
  new RollingPlot(at("plot-position"), history, {
    columns: [column("y")], bands: [{ colour: "position" }], factor: 1e3, least: 5, window: WINDOW_S, labels: false,
  }),
  new RollingPlot(at("plot-force"), history, {
    columns: [column("force")], bands: [{ colour: "force" }], least: 0.1, window: WINDOW_S, labels: false,
  }),
  new RollingPlot(at("plot-torque"), history, {
    columns: [column("torque_actual"), column("torque_cmd")],
    bands: [{ colour: "actual", width: 3 }, { colour: "command", dash: [6, 3] }],
    least: 0.1, window: WINDOW_S, labels: true,
  }),
];
const contact = new ContactPlot(at("plot-contact"), at("referent-stiffness"));

let run = { state: "none" };
let settings = null;
let contacts = [];
let marks = [];
let status = null; // to be shown in the next frame
let awaited = false; // a frame that draws what has come
let frames = 0;
let view = "live";

// --- what comes from the server

link.addEventListener("open", () => {
  forget(); // the server tells what there is
  showRun(run);
});
link.addEventListener("closed", () => {
  stop.hasControl = false;
  showState("lost", "no connection to the server");
  notice("No connection to the server. If the panel was started anew, open the address that it prints.");
});
link.addEventListener("signals", ({ detail }) => {
  history.append(detail);
  renew();
});
link.addEventListener("contact_points", ({ detail }) => {
  contact.append(detail);
  renew();
});
link.addEventListener("status", ({ detail }) => {
  status = detail;
  renew();
  stop.beatTimeout = detail.beat_timeout_s ?? 0;
  at("beat-watch").setAttribute("aria-checked", stop.beatTimeout > 0);
  at("recording").hidden = !detail.recording;
  at("recording-text").textContent = `recording, ${digits(detail.t_s, 3)} s`;
  if (run.state === "attached") showState(detail.ended ? "ended" : detail.phase, detail.trip || phase(detail));
});
link.addEventListener("settings", ({ detail }) => {
  settings = detail;
  controls.take(detail);
  scene.side = detail.side;
  at("k-law").textContent = detail.wall
    ? [detail.wall.law.replaceAll("_", " "), detail.turns?.length > 1 && "taking turns"].filter(Boolean).join(", ")
    : "hidden";
  showAbout();
});
link.addEventListener("contact", ({ detail }) => {
  contacts.push(detail);
  if (contacts.length > CONTACTS) contacts.shift();
  drawEnergy(at("energy"), contacts);
});
link.addEventListener("marks", ({ detail }) => {
  marks = marks.concat(detail.marks).slice(-100);
  showMarks(marks);
});
link.addEventListener("control", ({ detail }) => {
  stop.hasControl = detail.you;
  at("take-control").hidden = detail.you;
  document.body.classList.toggle("watching", !detail.you);
  notice(detail.you ? "" : detail.others ? "This page watches, and can stop. Another one may have control." : "Nobody has control: take it to change something.");
});
link.addEventListener("run", ({ detail }) => showRun(detail));
link.addEventListener("ab", ({ detail }) => controls.takeAB(detail));
link.addEventListener("presets", ({ detail }) => controls.takePresets(detail.presets));
link.addEventListener("problem", ({ detail }) => controls.say(detail.text, true));
link.addEventListener("blind", ({ detail }) => blind.take(detail));

// --- what is shown

function showRun(next) {
  const another = next.folder && run.folder && next.folder !== run.folder;
  const begins = ["attached", "starting"].includes(next.state) && !stop.running;
  run = next;
  stop.running = ["attached", "starting"].includes(run.state);
  scene.running = stop.running;
  showLatest.shown = -Infinity;
  renew();
  if (another) forget();
  if (another || begins) stop.reset();
  const idle = ["none", "ended", "failed"].includes(run.state);
  at("begin").hidden = !idle;
  document.querySelector(".controls").inert = idle;
  at("begin-title").textContent = { ended: "The run has ended", failed: "The run failed" }[run.state] ?? "No run in progress";
  if (run.text) at("begin-text").textContent = run.text;
  if (idle) {
    at("recording").hidden = true;
    status = null;
    showChatter({});
    loadConfigurations();
  }
  showState(run.state, {
    none: "no run", starting: "starting …", attached: `run ${run.name}`, ended: "run ended", failed: "run failed",
  }[run.state] ?? run.state);
  showAbout();
}

function forget() {
  history.clear();
  contact.clear();
  contacts = [];
  marks = [];
  drawEnergy(at("energy"), contacts);
  showMarks(marks);
  renew();
}

function showState(state, text) {
  const place = at("run-state");
  if (place.dataset.state !== state) place.dataset.state = state;
  setText(at("run-state-text"), text);
}

function phase({ phase: name, ended }) {
  return ended ? "run ended" : { rendering: "wall in force", leaving: "leaving", enabling: "enabling the drive", measuring: "measuring the delay" }[name] ?? name ?? "";
}

function showAbout() {
  define(at("about"), [
    ["Name", run.name], ["Folder", run.folder], ["Configuration", settings?.config],
    ["Bus", settings?.bus && `${settings.bus}, node ${settings.node_id}`],
    ["Cycle", settings?.cycle_s && `${digits(1e3 * settings.cycle_s)} ms`],
    ["Rated torque", settings?.rated_torque_nm && `${digits(settings.rated_torque_nm)} N·m`],
  ]);
}

function notice(text) {
  at("notice").textContent = text;
  at("notice").hidden = !text;
}

async function loadConfigurations() {
  const answer = await fetch("/api/configs");
  if (!answer.ok) return;
  const { configs } = await answer.json();
  const chosen = at("config").value;
  at("config").replaceChildren(...configs.map(({ name, title }) => {
    const option = document.createElement("option");
    option.value = name;
    option.textContent = title ? `${name}: ${title}` : name;
    return option;
  }));
  if (configs.some(({ name }) => name === chosen)) at("config").value = chosen;
}

async function start() {
  if (at("begin").hidden) return;
  notice("");
  at("start").disabled = true;
  try {
    await link.request({ do: "start", config: at("config").value }, 60_000);
  } catch (error) {
    notice(error.message);
  }
  at("start").disabled = false;
}

/**
 * Ask for a frame that draws the latest: as often as the server sends, and not without anything new.
 * Texts change in these frames as well, since the browser composes the page anew for each change.
 */
function renew() {
  if (awaited || view !== "live") return;
  awaited = true;
  const rest = reducedMotion() ? draw.begun + CALM_FRAME_MS - performance.now() : 0;
  if (rest > 0) setTimeout(() => requestAnimationFrame(draw), rest);
  else requestAnimationFrame(draw);
}

function draw(now) {
  awaited = false;
  draw.begun = now;
  frames++;
  scene.draw(now);
  for (const plot of plots) plot.draw(now);
  contact.draw(now);
  if (status) showStatus(status);
  status = null;
  if (now - showLatest.shown >= TEXT_MS) showLatest(now);
}
draw.begun = 0;

function showLatest(now) {
  showLatest.shown = now;
  const latest = (name) => (stop.running ? (history.lowest(column(name)) + history.highest(column(name))) / 2 : NaN);
  showKeyValues({
    y: latest("y"), force: latest("force"), stiffness: latest("stiffness_in_force"), radius: settings?.handle_radius_m,
  });
}
showLatest.shown = -Infinity;
setInterval(() => {
  at("f-page").textContent = `${Math.round(frames / 2)} frames/s`;
  frames = 0;
}, 2000);

// --- views, keys, buttons

function showView() {
  view = location.hash.startsWith("#recorded") ? "recorded" : "live";
  document.body.dataset.view = view;
  at("view-live").hidden = view !== "live";
  at("view-recorded").hidden = view !== "recorded";
  for (const name of ["live", "recorded"]) {
    if (name === view) at(`nav-${name}`).setAttribute("aria-current", "page");
    else at(`nav-${name}`).removeAttribute("aria-current");
  }
  if (view === "recorded") recorded.begin();
  renew();
}
addEventListener("hashchange", showView);

const help = () => (at("keys").open ? at("keys").close() : at("keys").showModal());
at("help").addEventListener("click", help);
at("keys-close").addEventListener("click", help);
at("theme").addEventListener("click", toggleTheme);
at("start").addEventListener("click", start);
at("take-control").addEventListener("click", () => link.request({ do: "take_control" }).catch((error) => notice(error.message)));

beginTabs(document.querySelector('[role="tablist"]'));
beginKeys({
  stop: () => stop.press(),
  arrow: (direction, far) => {
    if (view === "recorded") recorded.pan(direction);
    else controls.nudge((far ? 1.2 : 1.02) ** direction);
  },
  digit: (number) => {
    if (view === "recorded") return;
    if (!blind.answer(number)) controls.law(number);
  },
  b: () => (blind.running ? blind.show() : controls.switchAB()),
  m: () => controls.mark(),
  r: start,
  e: () => controls.end(),
  l: () => { location.hash = "#live"; },
  o: () => { location.hash = "#recorded"; },
  t: toggleTheme,
  "?": help,
  "+": () => recorded.zoom("in"),
  "-": () => recorded.zoom("out"),
  0: () => recorded.zoom("all"),
});

beginTheme();
showView();
new ResizeObserver(() => drawEnergy(at("energy"), contacts)).observe(at("energy"));
link.connect();
