// Settings of the run: what is moved here is asked of the run, and shown as the run has it.

import { digits, fixed, known, plain } from "./numbers.js";

const DEADBEAT = "+deadbeat";
const SETTLED_MS = 500;
const at = (id) => document.getElementById(id);

/** Logarithmic scale of a slider of 0 … 1000. */
class Logarithmic {
  constructor(low, high) {
    Object.assign(this, { low, high });
  }

  value(notch) {
    return this.low * (this.high / this.low) ** (notch / 1000);
  }

  notch(value) {
    return (1000 * Math.log(Math.max(value, this.low) / this.low)) / Math.log(this.high / this.low);
  }
}

const LIMITS = [
  ["torque_nm", "Torque", "N·m"],
  ["torque_rate_nm_per_s", "Torque rate", "N·m/s"],
  ["speed_rad_s", "Speed", "rad/s"],
  ["energy_j", "Energy put out in a contact", "J"],
];

export class Controls {
  #asked = null; // a change that waits until the one before has its answer
  #busy = false;
  #stiffness = new Logarithmic(1, 1000);
  #settings = null;
  #told = Promise.resolve(); // fulfilled once the settings are those after the last change
  #tell = null;
  #ab = { a: null, b: null, which: null, auto: false };

  constructor(link) {
    this.link = link;
    this.#wire();
  }

  /** Ask for a change; of several that come meanwhile, the latest values go as one. */
  async change(keys) {
    this.#asked = { ...this.#asked, ...keys };
    if (this.#busy) return;
    this.#busy = true;
    let taken = null;
    while (this.#asked) {
      const change = this.#asked;
      this.#asked = null;
      taken = await this.ask({ do: "change", ...change }, "in force");
      if (taken) {
        this.#told = new Promise((resolve) => {
          this.#tell = resolve;
          setTimeout(resolve, SETTLED_MS);
        });
      }
    }
    this.#busy = false;
    // What is in force is told shortly after the answer; until then the control stays where it is.
    setTimeout(() => this.#busy || this.#show(), taken ? SETTLED_MS : 0);
  }

  /** Send a request and say what became of it. Returns the answer, or null if it was refused. */
  async ask(what, done) {
    try {
      const answer = await this.link.request(what);
      this.say(done && known(answer.cycle) ? `${done} since cycle ${answer.cycle}` : done ?? "");
      return answer;
    } catch (error) {
      this.say(error.message, true);
      return null;
    }
  }

  say(text, failed = false) {
    const place = at("said");
    place.textContent = text;
    place.dataset.failed = failed;
  }

  /** Show the settings in force. */
  take(settings) {
    at("panel-wall").inert = !settings.wall; // a blind comparison hides it
    this.#settings = { ...settings, wall: settings.wall ?? this.#settings?.wall };
    this.#tell?.();
    if (!this.#settings.wall) return;
    this.#makeLaws();
    this.#makeLimits();
    if (!this.#busy) this.#show();
  }

  /** Stiffness by a factor, from where it stands. */
  nudge(factor) {
    const value = Number(at("stiffness").value) * factor;
    if (value > 0) this.#setStiffness(value);
  }

  law(number) {
    const law = this.#settings?.laws?.[number - 1];
    if (law) this.#changeLaw(law.name);
  }

  /** A or B; the server knows them once both are there. */
  #setAB(which, change) {
    const { a, b } = { ...this.#ab, [which]: change };
    this.takeAB({ ...this.#ab, a, b });
    if (a && b) this.ask({ do: "ab_set", a, b }, "A and B can be switched");
    else this.say(`${which.toUpperCase()} is the wall in force; change it, and take the other one`);
  }

  get ab() {
    return this.#ab;
  }

  switchAB() {
    this.useAB(this.#ab.which === "a" ? "b" : "a");
  }

  useAB(which) {
    if (!this.#ab.a || !this.#ab.b) {
      this.say("A and B first have to be taken from the wall in force", true);
      return;
    }
    this.ask({ do: "ab_use", which }, `${which.toUpperCase()} in force`);
  }

  takeAB(ab) {
    const set = (change) => (change && Object.keys(change).length ? change : null);
    this.#ab = { ...ab, a: set(ab.a), b: set(ab.b) };
    for (const which of ["a", "b"]) {
      at(`ab-${which}`).setAttribute("aria-pressed", ab.which === which);
      at(`ab-${which}-text`).textContent = wording(ab[which]);
    }
    at("ab-auto").setAttribute("aria-checked", ab.auto);
  }

  takePresets(presets) {
    at("presets").replaceChildren(...presets.map(({ name, change }) => {
      const item = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.title = wording(change);
      button.addEventListener("click", () => this.ask({ do: "preset_use", name }, `${name} in force`));
      const remove = document.createElement("button");
      remove.type = "button";
      remove.textContent = "×";
      remove.setAttribute("aria-label", `Remove ${name}`);
      remove.addEventListener("click", () => this.ask({ do: "preset_remove", name }, `${name} removed`));
      item.append(button, remove);
      return item;
    }));
  }

  /** The wall in force, as a change that brings it back. */
  wallInForce() {
    const { wall } = this.#settings;
    const change = {
      law: wall.law, deadbeat: wall.deadbeat, options: wall.options, position_rad: wall.position_rad,
      stiffness_nm_per_rad: wall.stiffness_nm_per_rad, cap: wall.cap, tension: wall.tension,
    };
    if (wall.damping_ratio) change.damping_ratio = wall.damping_ratio;
    else change.damping_nm_s_per_rad = wall.damping_nm_s_per_rad;
    return change;
  }

  #wire() {
    at("stiffness-slider").addEventListener("input", (event) => {
      this.#setStiffness(Number(this.#stiffness.value(event.target.valueAsNumber).toPrecision(3)));
    });
    at("stiffness").addEventListener("change", (event) => this.#setStiffness(event.target.valueAsNumber));
    at("damping-slider").addEventListener("input", (event) => this.#setDamping(this.#dampingAt(event.target.valueAsNumber)));
    at("damping").addEventListener("change", (event) => this.#setDamping(event.target.valueAsNumber));
    for (const radio of document.getElementsByName("damping-kind")) {
      radio.addEventListener("change", () => this.#showDamping(NaN));
    }
    at("position-slider").addEventListener("input", (event) => this.#setPosition(event.target.valueAsNumber));
    at("position").addEventListener("change", (event) => this.#setPosition(event.target.valueAsNumber));
    for (const radio of document.getElementsByName("tension")) {
      radio.addEventListener("change", () => this.change({ tension: radio.value }));
    }
    for (const radio of document.getElementsByName("guard")) {
      radio.addEventListener("change", () => this.change({ guard: { action: radio.value } }));
    }
    this.#wireSwitch("adapt", (on) => this.change({ operator: { adapt: on } }));
    this.#wireSwitch("ab-auto", (on) => this.ask({ do: "ab_auto", on }, on ? "A and B take turns" : "no turns"));
    this.#wireSwitch("beat-watch", (on) => this.ask(
      { do: "watch_beat", timeout_s: on ? at("beat-time").valueAsNumber : 0 },
      on ? "this page is watched" : "no beat is watched",
    ));
    for (const which of ["a", "b"]) {
      at(`ab-${which}`).addEventListener("click", () => this.useAB(which));
      at(`ab-take-${which}`).addEventListener("click", async () => {
        await this.#told;
        if (this.#settings) this.#setAB(which, this.wallInForce());
      });
    }
    const savePreset = () => {
      const name = at("preset-name").value.trim();
      if (name) this.ask({ do: "preset_save", name }, `${name} saved`);
      else this.say("a preset needs a name", true);
    };
    at("preset-save").addEventListener("click", savePreset);
    at("preset-name").addEventListener("keydown", (event) => event.key === "Enter" && savePreset());
    at("mark").addEventListener("click", () => this.mark());
    at("mark-text").addEventListener("keydown", (event) => event.key === "Enter" && this.mark());
    at("end").addEventListener("click", () => this.end());
  }

  mark() {
    this.ask({ do: "mark", text: at("mark-text").value.trim() || "mark" }, "marked");
    at("mark-text").value = "";
  }

  end() {
    this.ask({ do: "end" }, "ending the run");
  }

  #wireSwitch(id, action) {
    at(id).addEventListener("click", (event) => {
      const on = event.currentTarget.getAttribute("aria-checked") !== "true";
      event.currentTarget.setAttribute("aria-checked", on);
      action(on);
    });
  }

  #setStiffness(value) {
    if (!(value >= 0)) {
      this.#show();
      return;
    }
    this.#showStiffness(value);
    this.change({ stiffness_nm_per_rad: Number(value.toPrecision(6)) });
  }

  get #ratio() {
    return document.querySelector('[name="damping-kind"]:checked').value === "ratio";
  }

  #dampingAt(notch) {
    return Number((this.#ratio ? Math.max(notch / 500, 0.01) : (notch / 1000) ** 3).toPrecision(3));
  }

  #setDamping(value) {
    if (!(value >= 0)) {
      this.#show();
      return;
    }
    this.#showDamping(value);
    this.change(this.#ratio ? { damping_ratio: value } : { damping_nm_s_per_rad: value });
  }

  #setPosition(mrad) {
    if (!known(mrad)) {
      this.#show();
      return;
    }
    this.#showPosition(mrad);
    this.change({ position_rad: Number((mrad / 1000).toPrecision(6)) });
  }

  #changeLaw(name) {
    const deadbeat = name.endsWith(DEADBEAT);
    this.change({ law: deadbeat ? name.slice(0, -DEADBEAT.length) : name, deadbeat });
  }

  get #lawInForce() {
    const { law, deadbeat } = this.#settings.wall;
    return deadbeat && !law.endsWith(DEADBEAT) ? law + DEADBEAT : law;
  }

  #show() {
    if (!this.#settings) return;
    const { wall, guard, operator } = this.#settings;
    if (known(wall.stiffness_nm_per_rad)) this.#showStiffness(wall.stiffness_nm_per_rad);
    const kind = wall.damping_ratio ? "ratio" : "value";
    for (const radio of document.getElementsByName("damping-kind")) radio.checked = radio.value === kind;
    this.#showDamping(wall.damping_ratio || wall.damping_nm_s_per_rad);
    this.#showPosition(1e3 * wall.position_rad);
    for (const radio of document.getElementsByName("tension")) radio.checked = radio.value === wall.tension;
    for (const radio of document.getElementsByName("guard")) radio.checked = radio.value === guard?.action;
    for (const radio of document.getElementsByName("law")) radio.checked = radio.value === this.#lawInForce;
    at("adapt").setAttribute("aria-checked", Boolean(operator?.adapt));
    this.#showOptions();
  }

  #showStiffness(value) {
    const { low, high } = this.#stiffness;
    if (value > high) this.#stiffness = new Logarithmic(low, 10 ** Math.ceil(Math.log10(value)));
    put("stiffness", plain(value));
    at("stiffness-slider").value = this.#stiffness.notch(value);
    at("stiffness-slider").setAttribute("aria-valuetext", `${digits(value)} N·m/rad`);
    at("stiffness-low").textContent = this.#stiffness.low;
    at("stiffness-high").textContent = this.#stiffness.high;
  }

  #showDamping(value) {
    at("damping-unit").textContent = this.#ratio ? "ζ" : "N·m·s/rad";
    put("damping", plain(value));
    at("damping-slider").value = this.#ratio ? 500 * value || 0 : 1000 * Math.cbrt(value || 0);
    at("damping-slider").setAttribute("aria-valuetext", `${digits(value)} ${this.#ratio ? "ratio" : "N·m·s/rad"}`);
  }

  #showPosition(mrad) {
    put("position", plain(mrad));
    at("position-slider").value = mrad;
    at("position-slider").setAttribute("aria-valuetext", `${fixed(mrad, 0)} mrad`);
  }

  #makeLaws() {
    const laws = this.#settings.laws ?? [];
    const place = at("laws");
    const names = laws.map(({ name }) => name).join();
    if (place.dataset.names === names) return;
    place.dataset.names = names;
    place.replaceChildren(...laws.map(({ name }, i) => {
      const choice = document.createElement("label");
      const radio = document.createElement("input");
      Object.assign(radio, { type: "radio", name: "law", value: name });
      radio.addEventListener("change", () => this.#changeLaw(name));
      const text = document.createElement("span");
      text.textContent = name.replaceAll("_", " ");
      if (i < 9) {
        const key = document.createElement("kbd");
        key.textContent = i + 1;
        text.prepend(key, " ");
      }
      choice.append(radio, text);
      return choice;
    }));
  }

  #showOptions() {
    const { wall, laws } = this.#settings;
    const law = laws?.find(({ name }) => name === this.#lawInForce);
    const options = law?.options ?? [];
    const place = at("options");
    const shown = JSON.stringify([law?.name, options, wall.options]);
    if (place.dataset.shown === shown) return;
    place.dataset.shown = shown;
    place.replaceChildren(...options.map(({ name, low, high, default: usual }) => {
      const value = wall.options?.[name] ?? usual;
      return field(name.replaceAll("_", " "), "", value, (number) => {
        this.change({ options: { ...wall.options, [name]: number } });
      }, { min: low, max: high });
    }));
  }

  #makeLimits() {
    const place = at("limit-fields");
    const { limits = {} } = this.#settings;
    const shown = JSON.stringify(limits);
    if (place.dataset.shown === shown) return;
    place.dataset.shown = shown;
    place.replaceChildren(...LIMITS.map(([key, label, unit]) => {
      const value = limits[key];
      return field(label, unit, value, (number) => {
        if (known(value) && number > value) {
          this.say(`${label}: at most the ${plain(value)} ${unit} in force`, true);
          place.dataset.shown = "";
          this.#makeLimits();
        } else this.change({ limits: { [key]: number } });
      }, { min: 0, max: value, placeholder: "none" });
    }));
  }
}

/** Put a value into a field, unless somebody is typing there. */
function put(id, text) {
  const place = at(id);
  if (document.activeElement !== place || place.validity.badInput) place.value = text;
}

function field(label, unit, value, action, { min, max, placeholder = "" }) {
  const whole = document.createElement("label");
  const input = document.createElement("input");
  Object.assign(input, { type: "number", step: "any", placeholder, value: plain(value) });
  if (known(min)) input.min = min;
  if (known(max)) input.max = max;
  input.addEventListener("change", () => known(input.valueAsNumber) && action(input.valueAsNumber));
  const text = document.createElement("span");
  text.textContent = label;
  const measure = document.createElement("span");
  measure.className = "muted";
  measure.textContent = unit;
  whole.append(text, input, measure);
  return whole;
}

/** A change in a few words. */
export function wording(change) {
  if (!change || !Object.keys(change).length) return "not set";
  const {
    law, stiffness_nm_per_rad: stiffness, damping_ratio: ratio, damping_nm_s_per_rad: damping,
  } = change;
  return [
    law?.replaceAll("_", " "),
    known(stiffness) && `${digits(stiffness)} N·m/rad`,
    ratio ? `ζ ${digits(ratio, 2)}` : known(damping) && `${digits(damping, 2)} N·m·s/rad`,
  ].filter(Boolean).join(", ") || "another setting";
}
