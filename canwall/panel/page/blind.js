// The blind comparison, as the person at the handle sees it. Answers by key.

import { table } from "./tables.js";

const at = (id) => document.getElementById(id);

export class BlindComparison {
  #answers = [];
  #shown = null; // "1" or "2": the wall in force, no more is told

  constructor(link, controls) {
    this.link = link;
    this.controls = controls;
    at("blind-begin").addEventListener("click", () => this.#begin());
    at("blind-procedure").addEventListener("change", (event) => {
      for (const field of document.querySelectorAll("[data-for]")) {
        field.hidden = field.dataset.for !== event.target.value;
      }
    });
    at("blind-end").addEventListener("click", () => {
      if (this.running) controls.ask({ do: "blind_end" }, "the comparison has ended");
      else at("blind").hidden = true;
    });
  }

  #begin() {
    const procedure = at("blind-procedure").value;
    const number = (id) => at(id).valueAsNumber;
    if (procedure === "staircase") {
      this.controls.ask({
        do: "blind_begin", procedure, start: number("blind-start"), ceiling: number("blind-ceiling"),
        finest: number("blind-finest"),
      }, "");
      return;
    }
    const { a, b } = this.controls.ab;
    const pair = at("blind-with").value === "ab";
    if (pair && !(a && b)) {
      this.controls.say("A and B first have to be taken from the wall in force", true);
      return;
    }
    this.controls.ask({
      do: "blind_begin", procedure, question: at("blind-question").value,
      switch: at("blind-switch").value, repeats: number("blind-repeats"),
      ...(pair ? { reference: a, walls: [b] } : {}),
    }, "");
  }

  take(state) {
    const { running, procedure, trial, trials, text, answers, columns, rows, result, wall } = state;
    this.running = running;
    this.#shown = wall;
    document.body.classList.toggle("blinded", Boolean(running));
    at("blind").hidden = !running && !rows?.length && !result;
    at("blind-title").textContent = [
      procedure === "staircase" ? "Staircase" : "Blind comparison",
      running && trial && `trial ${trial}${trials ? ` of ${trials}` : ""}`,
    ].filter(Boolean).join(", ");
    at("blind-text").textContent = (running ? text : result) ?? "";
    at("blind-hint").replaceChildren();
    if (running && wall) {
      const key = document.createElement("kbd");
      key.textContent = "B";
      at("blind-hint").append(`Wall ${wall} is in force. `, key, " changes to the other one.");
    }
    at("blind-end").textContent = running ? "End the comparison" : "Close";
    this.#answers = (running && answers) || [];
    at("blind-answers").replaceChildren(...this.#answers.map(({ value, text: words }, i) => {
      const button = document.createElement("button");
      button.type = "button";
      const key = document.createElement("kbd");
      key.textContent = i + 1;
      button.append(key, ` ${words}`);
      button.addEventListener("click", () => this.#send(value));
      return button;
    }));
    at("blind-table").replaceChildren(...(rows?.length ? [table(columns, rows)] : []));
  }

  /** The other wall of the trial. */
  show() {
    this.controls.ask({ do: "blind_show", which: this.#shown === "1" ? "2" : "1" }, "");
  }

  /** Answer by the number of a key; returns false if no answer is asked for. */
  answer(number) {
    const answer = this.#answers[number - 1];
    if (answer) this.#send(answer.value);
    return Boolean(this.running);
  }

  #send(answer) {
    this.controls.ask({ do: "blind_answer", answer }, "");
  }
}
