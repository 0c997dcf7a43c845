// The connection to lavt: it is opened again after its end, sends no input that would arrive late, and keeps an
// emergency stop until the vehicle has confirmed it.

const VERSION = 2; // of the messages
const RETRY_MS = 1000;
const STOP_PERIOD_MS = 500; // between the messages of a stop that is not confirmed
const SILENT_MS = 400; // lavt sends a message at least every 50 ms
const MAX_UNSENT_BYTES = 1024; // some messages of the last milliseconds: the browser counts what it has just taken, too
const ANOTHER_VERSION = 4000; // closed by this page
const FINAL = [ANOTHER_VERSION, 4401, 4426]; // wrong token or version: the same page is never let in

export class Connection {
  #token;
  #listener;
  #socket = null;
  #heard_ms = 0; // when the newest message arrived, or the connection was opened
  #stop_ms = null; // when the stop that is not confirmed was last sent; null: there is none
  #isFinal = false; // there will be no other connection

  // `listener` has `takeStatus(status)`, `takeLane(lane)`, `takePrediction(prediction)`, `takeProbe(answer)`,
  // `takeUnit(buffer)` and `close(text)`.
  constructor(token, listener) {
    this.#token = token;
    this.#listener = listener;
    this.seen_us = 0; // `sent_us` of the newest message
    this.#open();
    setInterval(() => this.#repeatStop(), STOP_PERIOD_MS);
  }

  get isOpen() {
    return this.#socket !== null && this.#socket.readyState === WebSocket.OPEN;
  }

  // How long lavt has sent nothing.
  get silence_ms() {
    return performance.now() - this.#heard_ms;
  }

  // There is no connection, and there will be none.
  get isFinal() {
    return this.#isFinal;
  }

  // An emergency stop was made that the vehicle has not confirmed.
  get isStopPending() {
    return this.#stop_ms !== null;
  }

  send(message) {
    if (this.isOpen) this.#socket.send(JSON.stringify(message));
  }

  // Send an input, unless it would wait behind others: then the client and the vehicle stop, and a stop is not delayed.
  sendInput(input) {
    if (!this.isOpen || this.#socket.bufferedAmount > MAX_UNSENT_BYTES || this.silence_ms > SILENT_MS) return;
    this.send({ type: "input", seen_us: this.seen_us, ...input });
  }

  // Make an emergency stop: now or, without a connection, as soon as there is one.
  stop() {
    if (this.#stop_ms !== null && performance.now() - this.#stop_ms < STOP_PERIOD_MS) return; // a key that repeats
    this.#sendStop();
  }

  #sendStop() {
    this.#stop_ms = performance.now();
    this.send({ type: "stop" });
  }

  #repeatStop() {
    if (this.isStopPending && this.isOpen) this.#sendStop();
  }

  #open() {
    const socket = new WebSocket(`ws://${location.host}/socket`);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#heard_ms = performance.now();
      this.send({ type: "hello", version: VERSION, token: this.#token });
      if (this.isStopPending) this.#sendStop();
    };
    socket.onmessage = ({ data }) => this.#take(data);
    socket.onclose = ({ code, reason }) => {
      this.#socket = null;
      this.#isFinal = FINAL.includes(code);
      if (!this.#isFinal) setTimeout(() => this.#open(), RETRY_MS);
      this.#listener.close(reason || "the connection to lavt has ended");
    };
  }

  #take(data) {
    this.#heard_ms = performance.now();
    if (typeof data !== "string") {
      this.seen_us = Number(new DataView(data).getBigUint64(8));
      return this.#listener.takeUnit(data);
    }
    const message = JSON.parse(data);
    if (message.type === "probe") return this.#listener.takeProbe(message);
    if (message.type === "lane") return this.#listener.takeLane(message);
    if (message.type === "prediction") return this.#listener.takePrediction(message);
    if (message.version !== VERSION) return this.#socket.close(ANOTHER_VERSION, "reload this page: it is of another version of lavt");
    this.seen_us = message.sent_us;
    if (message.emergency_stop === "confirmed" && message.safety === "emergency_stop") this.#stop_ms = null;
    if (message.controller !== "") this.#stop_ms = null; // this page cannot stop the vehicle
    this.#listener.takeStatus(message);
  }
}
