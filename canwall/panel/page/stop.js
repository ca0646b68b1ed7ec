// The stop, and the beat that ends the run if this page or its server is gone.

import { seconds } from "./numbers.js";

const PATIENCE_MS = 400;
const SHOWN_MS = 15_000; // how long a stop that has been confirmed is shown

export class Stop {
  #pressed = false;

  constructor(link, button, text) {
    this.link = link;
    this.button = button;
    this.text = text;
    this.beatTimeout = 0; // as the run has it [s]; 0: no beat is watched
    this.hasControl = false;
    this.running = false;
    button.addEventListener("click", () => this.press());
    const clock = new Worker("/static/beat.js");
    clock.onmessage = () => {
      if (this.hasControl && !this.#pressed) link.beat();
    };
    link.addEventListener("open", () => {
      if (this.#pressed && this.running) this.#send();
    });
  }

  /** Another run: its stop has not been pressed. */
  reset() {
    this.#pressed = false;
    this.#show("", "");
  }

  /** Stop. From now on this page does not beat: a run that watches it ends either way. */
  press() {
    if (!this.running) {
      this.#show("", "no run in progress");
      return;
    }
    this.#pressed = true;
    this.#send();
  }

  async #send() {
    const since = performance.now();
    this.#show("pressed", "stopping …");
    const late = setTimeout(() => this.#unanswered(since), PATIENCE_MS);
    try {
      const answer = await this.link.request({ do: "stop" }, 60_000);
      clearTimeout(late);
      const took = answer.seconds ?? (performance.now() - since) / 1000;
      this.#show("confirmed", `stopped: zero torque, confirmed after ${seconds(took)}`);
      setTimeout(() => this.button.dataset.state === "confirmed" && this.#show("", ""), SHOWN_MS);
    } catch (error) {
      clearTimeout(late);
      if (/no (answer|connection)/.test(error.message)) this.#unanswered(since);
      else this.#show("failed", `${error.message}. ${this.#elsewhere()}`);
    }
  }

  #unanswered(since) {
    if (this.beatTimeout > 0) {
      const left = Math.max(this.beatTimeout - (performance.now() - since) / 1000, 0);
      this.#show("failed", `No answer from the server: the run ends when its beat is missed, in ${seconds(left)}`);
    } else {
      this.#show("failed", `No answer from the server. ${this.#elsewhere()}`);
    }
  }

  #elsewhere() {
    return this.beatTimeout > 0
      ? "The run ends when its beat is missed"
      : "No beat is watched: use Ctrl-C at the terminal, or the emergency stop";
  }

  #show(state, text) {
    this.button.dataset.state = state;
    this.text.textContent = text;
  }
}
