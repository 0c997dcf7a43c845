// Input by touch: the left field is the dead-man control and steers, the right one has throttle and brake.

import { limit } from "./hand.js";

const SHARE = 0.4; // of a field's size for full deflection
const LEFT = 1; // in `buttons`: only the left button of a mouse, or a finger

export class Touch {
  #steers = null; // the pointer on the left field, and where it began
  #pedals = null;
  #begins = new Map(); // by field: the event with which the finger on it began

  constructor(left, right) {
    this.release();
    this.#listen(left, (pointer) => { this.#steers = pointer; });
    this.#listen(right, (pointer) => { this.#pedals = pointer; });
    addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => this.release());
  }

  // Forget all fingers: only one that is put down again counts.
  release() {
    this.#begins.clear();
    this.#steers = this.#pedals = null;
  }

  get holds() {
    return this.#steers !== null;
  }

  get steering() {
    return this.#steers === null ? 0 : limit(-this.#steers.x, -1, 1);
  }

  get throttle() {
    return this.#pedals === null ? 0 : limit(-this.#pedals.y, 0, 1);
  }

  get brake() {
    return this.#pedals === null ? 0 : limit(this.#pedals.y, 0, 1);
  }

  // Call `set` with the deflection of a finger on a field, or null when it is lifted.
  #listen(field, set) {
    const end = () => {
      this.#begins.delete(field);
      set(null);
    };
    field.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      if (event.button !== 0 || this.#begins.has(field)) return;
      this.#begins.set(field, event);
      field.setPointerCapture(event.pointerId);
      set({ x: 0, y: 0 });
    });
    field.addEventListener("pointermove", (event) => {
      const begin = this.#begins.get(field);
      if (begin?.pointerId !== event.pointerId) return;
      if (event.buttons !== LEFT) return end(); // while another button is down, the release of this one is no event
      const { width, height } = field.getBoundingClientRect();
      set({
        x: (event.clientX - begin.clientX) / (width * SHARE),
        y: (event.clientY - begin.clientY) / (height * SHARE),
      });
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      field.addEventListener(name, (event) => {
        if (this.#begins.get(field)?.pointerId === event.pointerId) end();
      });
    }
  }
}
