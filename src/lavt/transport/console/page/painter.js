// Draws the pictures of the video on a canvas.
//
// `drawImage` of a picture in memory takes twice as long as converting it and putting its pixels on the canvas. A
// picture of a graphics processor is not in memory, and some browsers do not convert: those are drawn by `drawImage`.

const RGBA = { format: "RGBA", colorSpace: "srgb" };
const RGBA_BYTES = 4;

export class Painter {
  #context;
  #image = null; // of the size of the last picture that was converted
  #last = Promise.resolve();

  constructor(context) {
    this.#context = context;
  }

  // Draw a VideoFrame over the whole canvas, after those before it.
  paint(frame) {
    const painted = this.#last.then(() => this.#paint(frame));
    this.#last = painted.catch(() => {}); // the caller gets the error
    return painted;
  }

  async #paint(frame) {
    const { canvas } = this.#context;
    const { displayWidth: width, displayHeight: height } = frame;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    if (!(await this.#convert(frame, width, height))) return this.#context.drawImage(frame, 0, 0);
    this.#context.putImageData(this.#image, 0, 0);
  }

  // Convert a picture into `#image`; return whether it was possible.
  async #convert(frame, width, height) {
    if (frame.format !== "I420") return false;
    try {
      if (frame.allocationSize(RGBA) !== width * height * RGBA_BYTES) return false; // another format, or scaled
      if (this.#image?.width !== width || this.#image.height !== height) this.#image = new ImageData(width, height);
      await frame.copyTo(this.#image.data, RGBA);
    } catch {
      return false;
    }
    return true;
  }
}
