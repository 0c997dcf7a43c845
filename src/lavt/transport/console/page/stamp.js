// The stamp in the top left corner of each picture: 8 x 8 cells of 8 x 8 pixels, most significant bit first.

const CELLS = 8;
const CELL_PX = 8;
const STAMP_PX = CELLS * CELL_PX;
const BYTES_PER_PIXEL = { I420: 1, I420A: 1, NV12: 1, BGRX: 4, BGRA: 4, RGBX: 4, RGBA: 4 };

// Return the stamp of a VideoFrame in ns, as decimal text; null if it cannot be read.
export async function readStamp(frame) {
  const bytes = BYTES_PER_PIXEL[frame.format];
  const { x, y, width, height } = frame.visibleRect;
  if (bytes === undefined || width < STAMP_PX || height < STAMP_PX) return null;
  const rect = { x, y, width: STAMP_PX, height: STAMP_PX };
  const pixels = new Uint8Array(frame.allocationSize({ rect }));
  const [{ offset, stride }] = await frame.copyTo(pixels, { rect });
  let stamp = 0n;
  for (let row = 0; row < CELLS; row += 1) {
    for (let column = 0; column < CELLS; column += 1) {
      // The luma of a pixel in the middle of the cell, or its green.
      const at = offset + (row * CELL_PX + 4) * stride + (column * CELL_PX + 4) * bytes + (bytes === 4 ? 1 : 0);
      stamp = (stamp << 1n) | (pixels[at] > 128 ? 1n : 0n);
    }
  }
  return stamp < 2n ** 63n ? stamp.toString() : null;
}
