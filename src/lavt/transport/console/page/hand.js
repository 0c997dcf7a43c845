// The person's input from the keyboard: dead-man control, steering with a rate and a return, pedals.

const KEYS = {
  Space: "hold",
  ArrowLeft: "left", KeyA: "left",
  ArrowRight: "right", KeyD: "right",
  ArrowUp: "throttle", KeyW: "throttle",
  ArrowDown: "brake", KeyS: "brake",
};
const OTHER_KEYS = /^(Digit[0-9]|Escape)$/; // which the page uses, too; any other key may open a menu
const STEERING_PER_S = 1.6; // of full deflection
const RETURN_PER_S = 3.0;
const THROTTLE_PER_S = 2.0;
const BRAKE_PER_S = 4.0;
const NEXT_REPEAT_MS = 700; // the slowest repeat that systems offer is 500 ms
const FIRST_REPEAT_MS = 1500; // the longest delay that most systems offer is 1 s
const NO_REPEATS = "this system repeats no key that is held, so a lost release would not be noticed: turn the repeat on, or use another device";
const SILENT = "no key events arrived any more, so all keys count as released: release them, then hold them again";
const PRESS_AGAIN = "press an arrow key again: no key repeats any more, and soon all will count as released";

// While a menu is open or a window is dragged, the browser delivers no release of a key, and the page keeps the focus.
// So a key counts only while nothing can have opened one: the pointer is over the page, and no other key is pressed.
//
// The keyboard may also be taken without any event. But the key that was pressed last repeats while it is held, and its
// repeats end when another client gets the keys. So keys count only while events of keys arrive. When the key that
// repeats is released, no other key repeats, and one must be pressed again. A keyboard that does not repeat never holds.
export class Keyboard {
  #held = new Set(); // codes of the keys that are down
  #heard_ms = 0; // when the newest event of a key arrived
  #newest = ""; // what it was: "press", "repeat" or "release"
  #repeats = false; // this keyboard has repeated a key
  #isSilent = false; // the events ended although keys were down, and no key has been pressed since

  constructor() {
    this.steering = 0; // -1 to 1, left positive
    this.throttle = 0;
    this.brake = 0;
    this.isPointed = false; // the pointer is over the page
    addEventListener("keydown", (event) => this.#keyDown(event), true);
    addEventListener("keyup", (event) => this.#keyUp(event), true);
    addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => this.#leave());
    document.addEventListener("mousemove", () => { this.isPointed = true; });
    document.addEventListener("mouseleave", () => this.#leave());
    addEventListener("mousedown", ({ button }) => button !== 0 && this.release(), true);
    addEventListener("contextmenu", (event) => this.#prevent(event), true);
    addEventListener("dragstart", (event) => this.#prevent(event), true);
  }

  // Forget all keys: the release of a key may send no event.
  release() {
    this.#held.clear();
    this.steering = this.throttle = this.brake = 0;
  }

  get holds() {
    return this.#repeats && this.#is("hold");
  }

  // What the person must know; empty: nothing.
  get notice() {
    if (this.#isSilent) return this.#repeats ? SILENT : NO_REPEATS;
    return this.#held.size > 0 && this.#newest === "release" ? PRESS_AGAIN : "";
  }

  // Advance steering and pedals by `step_s`.
  advance(step_s) {
    this.#checkEvents();
    const turn = this.#is("left") - this.#is("right");
    if (turn !== 0) {
      // Turning back through the middle is as fast as the return.
      const rate = turn * this.steering < 0 ? RETURN_PER_S : STEERING_PER_S;
      this.steering = limit(this.steering + turn * rate * step_s, -1, 1);
    } else {
      const back = Math.min(Math.abs(this.steering), RETURN_PER_S * step_s);
      this.steering -= Math.sign(this.steering) * back;
    }
    this.throttle = this.#is("throttle") ? limit(this.throttle + THROTTLE_PER_S * step_s, 0, 1) : 0;
    this.brake = this.#is("brake") ? limit(this.brake + BRAKE_PER_S * step_s, 0, 1) : 0;
  }

  #is(action) {
    return [...this.#held].some((code) => KEYS[code] === action);
  }

  #note(event) {
    this.#heard_ms = performance.now();
    this.#newest = event;
    this.#repeats ||= event === "repeat";
  }

  #checkEvents() {
    const limit_ms = this.#newest === "repeat" ? NEXT_REPEAT_MS : FIRST_REPEAT_MS;
    if (this.#held.size === 0 || performance.now() - this.#heard_ms < limit_ms) return;
    if (this.#newest === "press") this.#repeats = false; // the repeat was turned off
    this.release();
    this.#isSilent = true;
  }

  #leave() {
    this.isPointed = false;
    this.release();
  }

  #prevent(event) {
    event.preventDefault();
    this.release();
  }

  #keyUp(event) {
    this.#note("release");
    this.#held.delete(event.code);
  }

  #keyDown(event) {
    this.#note(event.repeat ? "repeat" : "press");
    const hasModifier = event.ctrlKey || event.altKey || event.metaKey;
    if (hasModifier || !(event.code in KEYS)) {
      if (hasModifier || !(OTHER_KEYS.test(event.code) || event.key === "Escape")) this.release();
      return;
    }
    event.preventDefault();
    if (event.repeat || !this.isPointed) return; // a repeated event is no new press
    this.#held.add(event.code);
    this.#isSilent = false;
  }
}

export function limit(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
