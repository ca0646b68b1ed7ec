// The socket to the panel's server: requests with their answers, events, binary frames.

const PATIENCE_MS = 6000;
const SIGNALS = 1;
const CONTACT = 2;

/** Columns of a binary frame of signals, in the order in which they are sent. */
export const COLUMNS = [
  "y", "force", "torque_cmd", "torque_actual", "v_est", "wall_position", "stiffness_in_force",
];

/**
 * Return views of a frame of signals: no value is copied.
 * @param {ArrayBuffer} buffer
 * @returns {{t: Float64Array, low: Float32Array[], high: Float32Array[]}} in the order of COLUMNS
 */
export function signals(buffer) {
  const head = new DataView(buffer);
  const columns = head.getUint16(2, true);
  const n = head.getUint32(4, true);
  const low = [];
  const high = [];
  for (let c = 0, at = 16 + 8 * n; c < columns; c++, at += 8 * n) {
    low.push(new Float32Array(buffer, at, n));
    high.push(new Float32Array(buffer, at + 4 * n, n));
  }
  return { t: new Float64Array(buffer, 16, n), low, high };
}

function contact(buffer) {
  const head = new DataView(buffer);
  const n = head.getUint32(4, true);
  return {
    n,
    stiffness: head.getFloat64(8, true),
    t: new Float64Array(buffer, 16, n),
    y: new Float32Array(buffer, 16 + 8 * n, n),
    force: new Float32Array(buffer, 16 + 12 * n, n),
  };
}

/** Events: open, closed, signals, contact_points, and those of the server by their names. */
export class Link extends EventTarget {
  #socket = null;
  #waiting = new Map();
  #next = 1;
  #pause = 250;

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#pause = 250;
      this.#emit("open");
    };
    socket.onmessage = (message) => this.#take(message.data);
    socket.onclose = () => {
      for (const { reject } of this.#waiting.values()) reject(new Error("no connection to the server"));
      this.#waiting.clear();
      this.#emit("closed");
      setTimeout(() => this.connect(), this.#pause);
      this.#pause = Math.min(2 * this.#pause, 4000);
    };
    this.#socket = socket;
  }

  get open() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Send a request; the promise is its answer, or an Error with the reason of the refusal. */
  request(what, patience = PATIENCE_MS) {
    return new Promise((resolve, reject) => {
      if (!this.open) {
        reject(new Error("no connection to the server"));
        return;
      }
      const id = this.#next++;
      const timer = setTimeout(() => {
        this.#waiting.delete(id);
        reject(new Error("no answer from the server"));
      }, patience);
      this.#waiting.set(id, {
        resolve: (answer) => { clearTimeout(timer); resolve(answer); },
        reject: (error) => { clearTimeout(timer); reject(error); },
      });
      this.#socket.send(JSON.stringify({ id, ...what }));
    });
  }

  /** A sign of life; its answer does not matter. */
  beat() {
    if (this.open) this.#socket.send('{"id":0,"do":"beat"}');
  }

  #take(data) {
    if (data instanceof ArrayBuffer) {
      const kind = new Uint8Array(data, 0, 1)[0];
      if (kind === SIGNALS) this.#emit("signals", signals(data));
      else if (kind === CONTACT) this.#emit("contact_points", contact(data));
      return;
    }
    const message = JSON.parse(data);
    if ("answer" in message) {
      const waiting = this.#waiting.get(message.answer);
      this.#waiting.delete(message.answer);
      if (message.ok) waiting?.resolve(message);
      else waiting?.reject(new Error(message.error));
    } else {
      this.#emit(message.event, message);
    }
  }

  #emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
