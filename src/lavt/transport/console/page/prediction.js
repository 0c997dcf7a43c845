// The predictive display. A prediction arrives before its picture, and is drawn with it or not at all.

const KEPT = 64; // predictions for pictures that have not been decoded yet
const EARLY_NS = 12_000n; // how much a stamp from the RTP timestamp can be too early

export class Predictions {
  #kept = new Map(); // by RTP timestamp

  // Note a prediction: `{unit, stamp, left, right, ghost, stop}`; points are in pixels of the picture.
  take(prediction) {
    this.#kept.set(prediction.unit, prediction);
    if (this.#kept.size > KEPT) this.#kept.delete(this.#kept.keys().next().value);
  }

  // Return the prediction for a picture; null: there is none.
  of(unit) {
    const prediction = this.#kept.get(unit) ?? null;
    this.#kept.delete(unit);
    return prediction;
  }
}

// Return whether a prediction is for the picture from which this stamp was read.
export function isOfStamp(prediction, stamp) {
  const late_ns = BigInt(stamp) - BigInt(prediction.stamp);
  return late_ns >= 0n && late_ns < EARLY_NS;
}

export function drawPrediction(context, { left, right, ghost, stop }) {
  context.save();
  context.lineWidth = Math.max(2, context.canvas.width / 240);
  context.lineJoin = context.lineCap = "round";
  if (left.length > 1 && right.length > 1) {
    context.fillStyle = "#4aa8ff";
    context.globalAlpha = 0.35;
    context.fill(path([...left, ...right.toReversed()]));
    context.globalAlpha = 1;
  }
  context.strokeStyle = "#ffffff";
  if (ghost.length > 1) context.stroke(path(ghost));
  context.strokeStyle = "#ff3fd0";
  if (stop.length > 1) context.stroke(path(stop));
  context.restore();
}

function path(points) {
  const drawn = new Path2D();
  for (const [column, row] of points) drawn.lineTo(column + 0.5, row + 0.5); // pixel centres are whole numbers in LAVT
  return drawn;
}
