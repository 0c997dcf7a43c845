// A small plot of a value over the last seconds.

const LENGTH_MS = 20_000;
const FULL_MS = 500; // the top of the plot, unless a value is larger

export class History {
  #points = []; // [time in ms, value]
  #canvas;

  constructor(canvas) {
    this.#canvas = canvas;
  }

  // Add a value, or a gap (null).
  add(value) {
    const now_ms = performance.now();
    this.#points.push([now_ms, value]);
    while (this.#points[0][0] < now_ms - LENGTH_MS) this.#points.shift();
  }

  draw() {
    const now_ms = performance.now();
    const { width, height } = this.#canvas;
    const context = this.#canvas.getContext("2d");
    const top = Math.max(FULL_MS, ...this.#points.map(([, point]) => point ?? 0));
    context.clearRect(0, 0, width, height);
    context.strokeStyle = "#8ab4f8";
    context.beginPath();
    let isDrawing = false;
    for (const [time_ms, point] of this.#points) {
      if (point !== null) {
        const [x, y] = [width * (1 - (now_ms - time_ms) / LENGTH_MS), height * (1 - point / top)];
        if (isDrawing) context.lineTo(x, y);
        else context.moveTo(x, y);
      }
      isDrawing = point !== null;
    }
    context.stroke();
  }
}
