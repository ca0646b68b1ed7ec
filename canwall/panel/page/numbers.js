// Numbers as people read them.

const MINUS = "\u2212";

export const known = (value) => typeof value === "number" && Number.isFinite(value);

/** A fixed number of decimals; a dash for what is not known. */
export function fixed(value, decimals) {
  if (!known(value)) return "–";
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", MINUS);
}

/** So many significant digits, never in exponential notation. */
export function digits(value, significant = 3) {
  if (!known(value)) return "–";
  if (value === 0) return "0";
  const decimals = Math.min(Math.max(significant - 1 - Math.floor(Math.log10(Math.abs(value))), 0), 12);
  const text = value.toFixed(decimals);
  return text.replace("-", MINUS);
}

/** The same, fit for an input of type number. */
export function plain(value, significant = 4) {
  return known(value) ? String(Number(value.toPrecision(significant))) : "";
}

/** A time with the unit that suits it. */
export function seconds(value) {
  if (!known(value)) return "–";
  const size = Math.abs(value);
  if (size < 1e-3) return `${fixed(value * 1e6, 0)} µs`;
  if (size < 1) return `${digits(value * 1e3, 3)} ms`;
  return `${digits(value, 3)} s`;
}

/** An energy with the unit that suits it. */
export function joules(value) {
  if (!known(value)) return "–";
  const size = Math.abs(value);
  if (size < 1e-3) return `${digits(value * 1e6, 2)} µJ`;
  return size < 1 ? `${digits(value * 1e3, 2)} mJ` : `${digits(value, 2)} J`;
}

/** The least of 1, 2, 5, 10 …, or of other steps of a decade, that is not below a value. */
export function nice(value, steps = [1, 2, 5, 10]) {
  const decade = 10 ** Math.floor(Math.log10(value));
  const step = steps.find((each) => each * decade >= value * (1 - 1e-9));
  return step * decade;
}

const STEPS = [1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10];

/** A range that grows at once and shrinks after a while, so that a plot is calm. */
export class CalmRange {
  #small = 0;

  constructor(least, patience = 1000) {
    this.least = least;
    this.patience = patience; // [ms]
    this.reach = least;
  }

  take(reach, now) {
    const wanted = Math.max(nice(Math.max(known(reach) ? reach * 1.05 : 0, this.least), STEPS), this.least);
    if (wanted >= this.reach) {
      this.reach = wanted;
      this.#small = now;
    } else if (now - this.#small > this.patience) {
      this.reach = wanted;
      this.#small = now;
    }
    return this.reach;
  }
}
