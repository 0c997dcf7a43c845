// Whether the browser makes pictures of the screen. If the display server hangs, it makes none, but the page still has
// the focus, decodes video and reads its last keys as held.

const LIMIT_MS = 200;

export class Screen {
  #frame_ms = -Infinity; // when the browser last began to make a picture of the screen

  constructor() {
    const note = () => {
      this.#frame_ms = performance.now();
      requestAnimationFrame(note);
    };
    requestAnimationFrame(note);
  }

  // The page is visible, but its screen stands still.
  get isStalled() {
    return document.visibilityState === "visible" && performance.now() - this.#frame_ms >= LIMIT_MS;
  }
}
