// Ring buffers of typed arrays. Every value is written twice, a length apart, so that the latest
// ones are always one contiguous view.

export class History {
  /**
   * @param {number} capacity points that are kept
   * @param {number} columns columns, each with a lowest and a highest value per point
   */
  constructor(capacity, columns) {
    this.capacity = capacity;
    this.t = new Float64Array(2 * capacity);
    this.low = Array.from({ length: columns }, () => new Float32Array(2 * capacity));
    this.high = Array.from({ length: columns }, () => new Float32Array(2 * capacity));
    this.clear();
  }

  clear() {
    this.count = 0; // points ever written
  }

  /** The instant of the latest point. */
  get now() {
    return this.count ? this.t[(this.count - 1) % this.capacity] : NaN;
  }

  append({ t, low, high }) {
    if (t.length && t[0] < this.now) this.clear(); // another run
    for (let i = 0; i < t.length; i++) {
      const at = this.count % this.capacity;
      this.t[at] = this.t[at + this.capacity] = t[i];
      for (let c = 0; c < this.low.length; c++) {
        this.low[c][at] = this.low[c][at + this.capacity] = low[c][i];
        this.high[c][at] = this.high[c][at + this.capacity] = high[c][i];
      }
      this.count++;
    }
  }

  /** Begin and end of the points from an instant on, for subarray. */
  since(instant) {
    const kept = Math.min(this.count, this.capacity);
    const end = this.count <= this.capacity ? this.count : (this.count % this.capacity) + this.capacity;
    let begin = end - kept;
    for (let step = 1 << 20; step; step >>= 1) {
      if (begin + step <= end && this.t[begin + step - 1] < instant) begin += step;
    }
    return [begin, end];
  }

  lowest(column) {
    return this.count ? this.low[column][(this.count - 1) % this.capacity] : NaN;
  }

  highest(column) {
    return this.count ? this.high[column][(this.count - 1) % this.capacity] : NaN;
  }
}
