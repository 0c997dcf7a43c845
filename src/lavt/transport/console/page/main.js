// The console's page: connects to the client, sends the person's input, and shows video and state.

import { Offset, pageTime_us } from "./clock.js";
import { Calibration, Gamepads } from "./gamepad.js";
import { Keyboard } from "./hand.js";
import { showCalibration, showClosed, showStatus, showStopNotSent } from "./hud.js";
import { Touch } from "./touch.js";
import { Video } from "./video.js";

const VERSION = 1; // of the messages
const INPUT_PERIOD_MS = 20;
const PROBE_PERIOD_MS = 500;
const RETRY_MS = 1000;
const UNIT_HEAD_BYTES = 16;

const byId = (id) => document.getElementById(id);
const keyboard = new Keyboard();
const gamepads = new Gamepads(stop);
const touch = new Touch(byId("touch_steering"), byId("touch_pedals"));
let source = keyboard; // of the newest input
let calibration = null; // while the person calibrates a device
let socket = null;
let seen_us = 0; // `sent_us` of the newest message
let status = null;
let advanced_ms = performance.now();

let offset = new Offset();

const video = new Video(
  byId("picture"),
  (unit) => send({ type: "ack", unit }),
  () => send({ type: "lost" }),
  reportShown,
);
globalThis.lavtConsole = { get status() { return status; }, keyboard, touch, gamepads, video }; // for tests and the curious

// Send a message, and return whether there was a connection to lavt.
function send(message) {
  if (socket === null || socket.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

function stop() {
  const isSent = send({ type: "stop" });
  if (!isSent) showStopNotSent();
}

function connect() {
  const token = location.hash.slice(1);
  if (token === "") return showClosed("open the address that lavt has printed, with all that follows the #");
  if (!("VideoDecoder" in globalThis)) return showClosed("this browser cannot decode video (WebCodecs): use another");
  socket = new WebSocket(`ws://${location.host}/socket`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => send({ type: "hello", version: VERSION, token });
  socket.onmessage = ({ data }) => (typeof data === "string" ? takeText(JSON.parse(data)) : takeUnit(data));
  socket.onclose = ({ code, reason }) => {
    socket = null;
    status = null;
    offset = new Offset();
    video.close();
    keyboard.release();
    touch.release();
    showClosed(reason || "the connection to lavt has ended");
    if (code < 4000) setTimeout(connect, RETRY_MS); // a code above tells that another attempt is pointless
  };
}

function takeText(message) {
  if (message.type === "probe") offset.note(message);
  else takeStatus(message);
}

function takeStatus(message) {
  if (message.version !== VERSION) return socket.close(4000, "reload this page: it is of another version of lavt");
  seen_us = message.sent_us;
  status = message;
  const canHold = source !== keyboard || keyboard.isPointed || !matchMedia("(any-hover: hover)").matches;
  showStatus(status, source, video, frameAge_ms(), canHold);
  showCalibration(calibration);
}

function takeUnit(buffer) {
  const head = new DataView(buffer, 0, UNIT_HEAD_BYTES);
  seen_us = Number(head.getBigUint64(8));
  const isKeyframe = (head.getUint8(1) & 1) === 1;
  video.push({ data: new Uint8Array(buffer, UNIT_HEAD_BYTES), unit: head.getUint32(4), isKeyframe });
}

// Report when a picture was shown, on the page's clock, with the offset to the client's clock.
function reportShown(times) {
  const best = offset.best;
  if (best === null) return;
  video.stamp_us = Number(BigInt(times.stamp) / 1000n);
  video.shown_ms = (times.shown_us + best.offset_us - video.stamp_us) / 1000;
  send({ type: "shown", ...times, ...best });
}

function frameAge_ms() {
  const best = offset.best;
  return best === null || video.stamp_us === null ? null : (pageTime_us() + best.offset_us - video.stamp_us) / 1000;
}

function sendInput() {
  const now_ms = performance.now();
  keyboard.advance(Math.min((now_ms - advanced_ms) / 1000, 0.1));
  advanced_ms = now_ms;
  if (calibration === null) gamepads.poll();
  else calibration.poll();
  if (calibration?.next === null) calibration = null;
  if (status?.role !== "drives") return;
  source = [keyboard, touch, gamepads].find(({ holds }) => holds) ?? (gamepads.id === "" ? keyboard : gamepads);
  const { holds, steering, throttle, brake } = source;
  const isSeen = document.visibilityState === "visible" && document.hasFocus();
  const live = isSeen && calibration === null && !gamepads.lost;
  send({ type: "input", seen_us, held: holds, live, steering, throttle, brake });
}

function chooseDelay(video_ms, control_ms) {
  send({ type: "delay", video_ms, control_ms });
}

addEventListener("keydown", (event) => {
  if (event.code === "Escape") stop();
  const condition = /^Digit[0-9]$/.test(event.code) && status?.conditions?.[Number(event.code.slice(5))];
  if (condition && !event.repeat && !event.ctrlKey && !event.altKey) chooseDelay(condition[1], condition[2]);
});
byId("stop").onclick = (event) => {
  stop();
  event.currentTarget.blur(); // the space bar must not press the button
};
byId("calibrate").onclick = (event) => {
  calibration = calibration === null ? new Calibration() : null;
  event.currentTarget.blur();
};
byId("release").onclick = (event) => {
  send({ type: "release" });
  event.currentTarget.blur();
};
byId("take").onclick = (event) => {
  send({ type: "drive" });
  event.currentTarget.blur();
};
byId("conditions").onclick = ({ target }) => {
  if (target.dataset.video === undefined) return;
  chooseDelay(Number(target.dataset.video), Number(target.dataset.control));
  target.blur();
};
for (const slider of [byId("video_delay"), byId("control_delay")]) {
  slider.oninput = () => chooseDelay(byId("video_delay").valueAsNumber, byId("control_delay").valueAsNumber);
  slider.onchange = () => slider.blur();
}
setInterval(sendInput, INPUT_PERIOD_MS);
setInterval(() => {
  send({ type: "probe", sent_us: pageTime_us() });
  video.check();
}, PROBE_PERIOD_MS);
addEventListener("hashchange", () => location.reload());
connect();
