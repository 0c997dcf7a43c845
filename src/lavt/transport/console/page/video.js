// The video: access units are decoded by WebCodecs, drawn at once, and acknowledged. Then the stamp is read.

import { pageTime_us } from "./clock.js";
import { drawLane } from "./lane.js";
import { Painter } from "./painter.js";
import { Predictions, drawPrediction, isOfStamp } from "./prediction.js";
import { readStamp } from "./stamp.js";

const MAX_DECODING = 3; // access units in the decoder
const MAX_DECODING_WITH_LANES = 8; // as many as lavt sends to a page that watches
const DECODING_LIMIT_US = 1_000_000;

// Return whether this browser decodes the video's format; some have WebCodecs, but no decoder for it.
export async function canDecode() {
  try {
    return (await VideoDecoder.isConfigSupported({ codec: "avc1.42C01E" })).supported === true;
  } catch {
    return false;
  }
}

export class Video {
  #context;
  #painter;
  #decoder = null;
  #pending = new Map(); // by timestamp in the decoder: [RTP timestamp, time of arrival in us]
  #number = 0;
  #acknowledge;
  #lose;
  #report;

  // `acknowledge(unit)` is called when a picture has been drawn, `lose()` when only a keyframe can be decoded, and
  // `report(times)` when a picture with a readable stamp is about to appear.
  constructor(canvas, acknowledge, lose, report) {
    this.#report = report;
    this.#context = canvas.getContext("2d", { desynchronized: true, alpha: false });
    this.#painter = new Painter(this.#context);
    this.#acknowledge = acknowledge;
    this.#lose = lose;
    this.lanes = null; // the lanes to draw; null: none are detected
    this.lanesDrawn = 0;
    this.predictions = new Predictions();
    this.predictionsDrawn = 0;
    this.shown = 0;
    this.stamp_us = null; // of the newest picture that was shown
    this.shown_ms = null; // from the stamp until the newest picture was shown
    this.errors = 0;
  }

  // Decode a unit: `{data, unit, isKeyframe}`.
  push({ data, unit, isKeyframe }) {
    if (this.#decoder === null) {
      if (!isKeyframe) return this.#lose();
      if (!this.#open(data)) return this.#fail();
    }
    if (this.#pending.size >= (this.lanes === null ? MAX_DECODING : MAX_DECODING_WITH_LANES)) return this.#fail();
    const timestamp = ++this.#number;
    this.#pending.set(timestamp, [unit, pageTime_us()]);
    try {
      this.#decoder.decode(new EncodedVideoChunk({ type: isKeyframe ? "key" : "delta", timestamp, data }));
    } catch {
      this.#fail();
    }
  }

  // Give up an access unit from which the decoder makes neither a picture nor an error.
  check() {
    const [oldest] = this.#pending.values();
    if (oldest !== undefined && pageTime_us() - oldest[1] > DECODING_LIMIT_US) this.#fail();
  }

  close() {
    if (this.#decoder !== null && this.#decoder.state !== "closed") this.#decoder.close();
    this.#decoder = null;
    this.#pending.clear();
  }

  // Return whether there is a decoder for the keyframe.
  #open(data) {
    const codec = codecOf(data);
    if (codec === null) return false;
    const decoder = new VideoDecoder({
      output: (frame) => this.#show(frame, decoder),
      error: () => decoder === this.#decoder && this.#fail(),
    });
    try {
      decoder.configure({ codec, optimizeForLatency: true, hardwareAcceleration: "no-preference" });
    } catch {
      return false;
    }
    this.#decoder = decoder;
    return true;
  }

  async #show(frame, decoder) {
    let isDrawn = false;
    try {
      const decoded_us = pageTime_us();
      const [unit, arrived_us] = this.#pending.get(frame.timestamp) ?? [];
      if (decoder !== this.#decoder || unit === undefined) return;
      this.#pending.delete(frame.timestamp);
      const lane = this.lanes === null ? null : await this.lanes.of(unit);
      if (decoder !== this.#decoder) return; // it was closed while the picture waited
      await this.#painter.paint(frame);
      if (this.#context.isContextLost?.()) return this.#fail(); // then nothing has been drawn
      if (lane !== null) drawLane(this.#context, lane);
      const prediction = this.predictions.of(unit);
      if (prediction !== null) drawPrediction(this.#context, prediction);
      isDrawn = true;
      this.shown += 1;
      this.#acknowledge(unit);
      const times = { unit, arrived_us, decoded_us, drawn_us: pageTime_us() };
      const shown = this.#untilShown(this.shown);
      const stamp = await readStamp(frame);
      if (lane !== null && stamp !== null) this.#countLane(lane.stamp === stamp);
      if (prediction !== null && stamp !== null) this.#countPrediction(isOfStamp(prediction, stamp));
      frame.close(); // a page that is hidden shows nothing, and must not keep the decoder's pictures
      const shown_us = await shown;
      if (stamp !== null && shown_us !== null) this.#report({ ...times, stamp, shown_us });
    } catch {
      if (isDrawn) this.errors += 1;
      else this.#fail(); // it was not acknowledged
    } finally {
      frame.close();
    }
  }

  #countLane(isOfPicture) {
    if (isOfPicture) this.lanesDrawn += 1;
    else this.errors += 1; // the lane of another picture was drawn
  }

  #countPrediction(isOfPicture) {
    if (isOfPicture) this.predictionsDrawn += 1;
    else this.errors += 1; // the prediction for another picture was drawn
  }

  // Return when the picture with this number appears; null if the page is hidden, or a newer one is drawn over it first.
  #untilShown(number) {
    if (document.visibilityState !== "visible") return null;
    return new Promise((resolve) =>
      requestAnimationFrame(() => resolve(number === this.shown ? pageTime_us() : null)),
    );
  }

  #fail() {
    this.errors += 1;
    this.close();
    this.#lose();
  }
}

// The codec string of WebCodecs from the SPS in an access unit (Annex B); null: it has none.
function codecOf(data) {
  for (let i = 0; i + 6 < data.length; i += 1) {
    if (data[i] === 0 && data[i + 1] === 0 && data[i + 2] === 1 && (data[i + 3] & 0x1f) === 7) {
      return "avc1." + [...data.subarray(i + 4, i + 7)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    }
  }
  return null;
}
