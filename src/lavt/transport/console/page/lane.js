// The lanes that a controller has detected. A lane arrives some milliseconds after its picture, which waits for it.

const WAIT_MS = 100; // if no lane arrives for a picture, as when the controller skips it
const KEPT = 64; // lanes whose pictures have not been decoded yet, which are larger and arrive later

export class Lanes {
  #kept = new Map(); // by RTP timestamp
  #waiting = null; // {unit, end(lane)} of the picture that waits

  // Note a lane: `{unit, stamp, confidence, left, right}`.
  take(lane) {
    if (this.#waiting?.unit === lane.unit) return this.#waiting.end(lane);
    this.#kept.set(lane.unit, lane);
    if (this.#kept.size > KEPT) this.#kept.delete(this.#kept.keys().next().value);
  }

  // Return the lane of a picture, at the latest when the next picture asks; null: there is none.
  of(unit) {
    this.#waiting?.end(null);
    const lane = this.#kept.get(unit);
    this.#kept.delete(unit);
    if (lane !== undefined) return Promise.resolve(lane);
    return new Promise((resolve) => {
      const end = (found) => {
        clearTimeout(timer);
        this.#waiting = null;
        resolve(found);
      };
      const timer = setTimeout(() => end(null), WAIT_MS);
      this.#waiting = { unit, end };
    });
  }
}

// Draw a lane over its picture; its points are in pixels of the picture.
export function drawLane(context, { confidence, left, right }) {
  if (left.length < 2 || right.length < 2) return;
  context.save();
  context.fillStyle = "#34a853";
  context.globalAlpha = 0.25 * confidence;
  context.fill(path([...left, ...right.toReversed()]));
  context.globalAlpha = 1;
  context.strokeStyle = "#5bf08a";
  context.lineWidth = Math.max(2, context.canvas.width / 240);
  context.lineJoin = "round";
  for (const line of [left, right]) context.stroke(path(line));
  context.restore();
}

function path(points) {
  const drawn = new Path2D();
  for (const [column, row] of points) drawn.lineTo(column + 0.5, row + 0.5); // pixel centres are whole numbers in LAVT
  return drawn;
}
