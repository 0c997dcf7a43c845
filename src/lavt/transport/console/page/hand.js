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

// While a menu is open or a window is dragged, the browser delivers no release of a key, and the page keeps the focus.
// So a key counts only while nothing can have opened one: the pointer is over the page, and no other key is pressed.
export class Keyboard {
  #held = new Set(); // codes of the keys that are down

  constructor() {
    this.steering = 0; // -1 to 1, left positive
    this.throttle = 0;
    this.brake = 0;
    this.isPointed = false; // the pointer is over the page
    addEventListener("keydown", (event) => this.#keyDown(event), true);
    addEventListener("keyup", (event) => this.#held.delete(event.code), true);
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
    return this.#is("hold");
  }

  // Advance steering and pedals by `step_s`.
  advance(step_s) {
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

  #leave() {
    this.isPointed = false;
    this.release();
  }

  #prevent(event) {
    event.preventDefault();
    this.release();
  }

  #keyDown(event) {
    const hasModifier = event.ctrlKey || event.altKey || event.metaKey;
    if (hasModifier || !(event.code in KEYS)) {
      if (hasModifier || !OTHER_KEYS.test(event.code)) this.release();
      return;
    }
    event.preventDefault();
    if (!event.repeat && this.isPointed) this.#held.add(event.code); // a repeated event is no new press
  }
}

export function limit(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
