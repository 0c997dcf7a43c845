// The console's page: connects to the client, sends the person's input, and shows video and state.

import { Offset, pageTime_us } from "./clock.js";
import { Connection } from "./connection.js";
import { Calibration, Gamepads } from "./gamepad.js";
import { Keyboard } from "./hand.js";
import { showCalibration, showClosed, showSilence, showStatus } from "./hud.js";
import { Lanes } from "./lane.js";
import { Screen } from "./screen.js";
import { Sources } from "./source.js";
import { Touch } from "./touch.js";
import { Video, canDecode } from "./video.js";

const INPUT_PERIOD_MS = 20;
const PROBE_PERIOD_MS = 500;
const UNIT_HEAD_BYTES = 16;
const FULL_STEERING_RAD = 0.5; // at the end of the meter, if a controller drives

const byId = (id) => document.getElementById(id);
const keyboard = new Keyboard();
const gamepads = new Gamepads(stop);
const touch = new Touch(byId("touch_steering"), byId("touch_pedals"));
const sources = new Sources([keyboard, touch, gamepads], () => (gamepads.id === "" ? keyboard : gamepads));
const screen = new Screen();
let calibration = null; // while the person calibrates a device
let connection = null;
let status = null;
let closedText = ""; // why there is no connection
let advanced_ms = performance.now();

let offset = new Offset();

const video = new Video(
  byId("picture"),
  (unit) => send({ type: "ack", unit }),
  () => send({ type: "lost" }),
  reportShown,
);
globalThis.lavtConsole = { get status() { return status; }, keyboard, touch, gamepads, video, send }; // for tests and the curious

function send(message) {
  connection?.send(message);
}

function stop() {
  if (isWatching()) return;
  connection?.stop();
  if (connection?.isOpen !== true) showClosed(closedText, connection === null || connection.isFinal ? "lost" : "pending");
}

// A controller drives, and this page can command nothing.
function isWatching() {
  return Boolean(status?.controller);
}

async function connect() {
  const token = location.hash.slice(1);
  if (token === "") return showClosed("open the address that lavt has printed, with all that follows the #");
  if (!("VideoDecoder" in globalThis)) return showClosed("this browser cannot decode video (WebCodecs): use another");
  if (!(await canDecode())) return showClosed("this browser cannot decode H.264, the format of the video: install its codecs, or use another browser");
  const takeProbe = (answer) => offset.note(answer);
  const takeLane = (lane) => video.lanes?.take(lane);
  const takePrediction = (prediction) => video.predictions.take(prediction);
  connection = new Connection(token, { takeStatus, takeLane, takePrediction, takeUnit, takeProbe, close });
}

function close(text) {
  status = null;
  offset = new Offset();
  video.close();
  keyboard.release();
  touch.release();
  closedText = text;
  if (connection.isStopPending) showClosed(text, connection.isFinal ? "lost" : "pending");
  else showClosed(text);
}

function takeStatus(message) {
  status = message;
  if (isWatching()) video.lanes ??= new Lanes();
  showStatus(status, isWatching() ? commanded(status) : sources.current, video, frameAge_ms(), connection.isStopPending, keyboardNotice());
  showCalibration(calibration);
}

// The controller's last command, as the input of a person.
function commanded({ command }) {
  const [steering_rad, throttle, brake] = command ?? [0, 0, 0];
  return { steering: Math.max(-1, Math.min(1, steering_rad / FULL_STEERING_RAD)), throttle, brake };
}

// What the person must know about the keys; empty while another device drives.
function keyboardNotice() {
  if (sources.current !== keyboard) return "";
  if (!keyboard.isPointed && matchMedia("(any-hover: hover)").matches) {
    return "move the pointer over this page and leave it there: keys count only then";
  }
  return keyboard.notice;
}

function takeUnit(buffer) {
  const head = new DataView(buffer, 0, UNIT_HEAD_BYTES);
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
  if (calibration?.next === null) {
    calibration = null;
    gamepads.endCalibration();
  }
  sources.poll();
  if (status?.role !== "drives") return;
  const { steering, throttle, brake } = sources.current;
  if (screen.isStalled && sources.holds) return; // as if the page were stopped; a short stall is bridged
  const live = document.visibilityState === "visible" && document.hasFocus() && calibration === null && !gamepads.lost;
  connection.sendInput({ held: sources.holds, live, steering, throttle, brake });
}

function chooseDelay(video_ms, control_ms) {
  send({ type: "delay", video_ms, control_ms });
}

addEventListener("keydown", (event) => {
  if (event.code === "Escape" || event.key === "Escape") stop();
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
  if (status !== null) showSilence(connection.silence_ms, connection.isStopPending);
}, PROBE_PERIOD_MS);
addEventListener("hashchange", () => location.reload());
connect();
