// What the page shows besides the picture.

import { QUESTIONS, devices } from "./gamepad.js";
import { History } from "./history.js";

const byId = (id) => document.getElementById(id);
const SAFETY = {
  disarmed: "disarmed", arming: "arming", driving: "driving", degraded: "degraded",
  safe_stop: "safe stop", emergency_stop: "emergency stop",
};
const STOP_NOT_SENT = "emergency stop NOT sent: no connection to lavt. Use another emergency stop.";
const STOP_SENT_LATER = "It is sent if the connection returns";
const STOP_NOT_CONFIRMED = "emergency stop sent, not confirmed yet";
const STALE_MS = 1000; // lavt sends a status every 50 ms
const FIGURES_PERIOD_MS = 200; // nobody reads them faster, and each change delays the video by a layout of the page
const history = new History(byId("history"));
let figures_ms = -Infinity; // when the figures were last shown
const HANDS = {
  not_seen: "release the dead-man control (the space bar), then hold it",
  not_live: "click the page, then release the dead-man control (the space bar) and hold it",
  old_input: "this page was stopped for a moment: release the dead-man control, then hold it",
  no_input: "this page sent no input for a moment: release the dead-man control, then hold it",
};

// Change the text of an element: each change, also to the same text, makes the browser lay out and paint the page again.
function write(name, text) {
  const element = byId(name);
  if (element.textContent !== String(text)) element.textContent = text;
}

// `stop` is "pending" if an emergency stop waits for a connection, "lost" if there will be none, and else empty.
export function showClosed(text, stop = "") {
  write("connection", "not connected");
  showSafety("");
  write("reason", "");
  byId("stop").className = "";
  const warnings = { "": text, pending: `${STOP_NOT_SENT} ${STOP_SENT_LATER}`, lost: `${STOP_NOT_SENT} ${text}` };
  write("hint", warnings[stop]);
  byId("take").hidden = byId("release").hidden = byId("speed_limit").hidden = true;
  markOld(true);
}

// Dim the figures while they are old.
function markOld(isOld) {
  document.body.classList.toggle("old", isOld);
}

// Show nothing old as the present state if lavt has sent nothing for a while.
export function showSilence(silence_ms, isStopPending) {
  if (silence_ms < STALE_MS) return;
  const silence = `no status from lavt for ${Math.floor(silence_ms / 1000)} s`;
  write("connection", silence);
  markOld(true);
  showSafety("");
  write("reason", "");
  const hint = isStopPending
    ? `${STOP_NOT_CONFIRMED}, and ${silence}: use another emergency stop`
    : `${silence}: the page does not know what the vehicle does`;
  write("hint", hint);
}

function showSafety(name) {
  write("safety", SAFETY[name] ?? "no state");
  byId("safety").className = `badge ${name in SAFETY ? name : ""}`;
}

// `age_ms` is the age of the picture on the screen, from its stamp; null: unknown. `notice` is about the keys.
export function showStatus(status, input, video, age_ms, isStopPending, notice) {
  const isWatching = status.controller !== "";
  document.body.classList.toggle("watching", isWatching);
  markOld(false);
  const watched = isWatching ? ` ${status.controller}` : "";
  write("connection", status.role === "drives" ? "this page drives" : `this page watches${watched}`);
  showSafety(status.safety);
  const rejected = status.rejected && `command rejected: ${status.rejected}`;
  const limited = status.limited && `limited: ${status.limited}`;
  const requested = status.requested_by && `${status.requested_by} requests control`;
  write("reason", [status.reason, requested, rejected, limited].filter(Boolean).join(" · "));
  write("hint", hint(status, input, isStopPending, notice));
  byId("release").hidden = !(status.role === "drives" && status.has_control && status.requested_by !== "");
  write("release", `Hand over to ${status.requested_by}`);
  byId("take").hidden = !(status.role === "watches" && status.can_drive);
  write("speed_kmh", status.speed_mps === null ? "–" : (status.speed_mps * 3.6).toFixed(0));
  write("target_kmh", (status.target_mps * 3.6).toFixed(0));
  showSpeedLimit(status);
  byId("steering").value = -input.steering; // to the right on the screen is to the right
  byId("throttle").value = input.throttle;
  byId("brake").value = input.brake;
  for (const element of document.querySelectorAll("[data-latency]")) element.hidden = !status.shows_latency;
  history.add(age_ms);
  if (performance.now() - figures_ms >= FIGURES_PERIOD_MS) showFigures(status, video, age_ms);
  byId("stop").className = isPast(status) ? "" : status.emergency_stop;
  showNetwork(status);
}

function showFigures(status, video, age_ms) {
  figures_ms = performance.now();
  write("video_ms", ms(status.video_ms));
  write("round_trip_ms", ms(status.round_trip_ms));
  write("shown_ms", ms(video.shown_ms));
  write("age_ms", ms(age_ms));
  write("bit_rate", `${(status.bit_rate_bps / 1e6).toFixed(1)} Mb/s`);
  write("lost_share", status.lost_share === null ? "–" : `${(status.lost_share * 100).toFixed(1)} %`);
  write("errors", video.errors);
  history.draw();
}

// The speed above which the vehicle brakes, rounded down, and why. A vehicle without a speed governor reports none.
function showSpeedLimit({ speed_limit_mps, speed_limit_reason }) {
  byId("speed_limit").hidden = speed_limit_mps === null;
  const reason = speed_limit_reason && `: ${speed_limit_reason}`;
  write("speed_limit", `at most ${Math.floor(speed_limit_mps * 3.6)} km/h${reason}`);
}

// The vehicle has executed an emergency stop of this client, but is in another state now.
function isPast({ emergency_stop, safety }) {
  return emergency_stop === "confirmed" && safety !== "emergency_stop";
}

// The page of a controller's drive has no other hint than about the state.
function watchHint({ safety, state_age_ms }) {
  if (safety === "") return "waiting for the vehicle";
  return state_age_ms > STALE_MS ? `no state of the vehicle for ${Math.floor(state_age_ms / 1000)} s` : "";
}

function hint(status, input, isStopPending, notice) {
  if (status.controller !== "") return watchHint(status);
  if (isStopPending || status.emergency_stop === "sent") return STOP_NOT_CONFIRMED;
  if (isPast(status)) {
    return "an earlier emergency stop was confirmed, but the vehicle is in another state now. To drive again, end lavt with Ctrl-C and start it again";
  }
  if (status.emergency_stop === "confirmed") return "emergency stop: the vehicle has confirmed it. To drive again, end lavt with Ctrl-C and start it again";
  if (status.role === "watches") return status.can_drive ? "no page drives: press the button to drive from this one" : "another page drives; this one can only watch, and stop";
  if (status.phase === "seeking" || status.phase === "stopped" || status.phase === "watching") {
    return status.session_reason || "waiting for the vehicle";
  }
  if (status.hand in HANDS) return HANDS[status.hand];
  if (notice !== "") return notice;
  if (status.phase === "arming") {
    if (status.session_reason) return status.session_reason;
    if (status.hand === "open") return "hold the dead-man control (the space bar) for a second to arm";
    return input.throttle > 0.05 ? "release the throttle to arm" : "arming: keep holding";
  }
  return status.hand === "held" ? "" : "the dead-man control was released: the vehicle stops";
}

function ms(value) {
  return value === null ? "–" : `${value.toFixed(value < 10 ? 1 : 0)} ms`;
}

// Show the question of a calibration; without one, whether there is a device to calibrate.
export function showCalibration(calibration) {
  byId("calibrate").hidden = calibration === null && devices().length === 0;
  write("calibrate", calibration === null ? "Calibrate a wheel or gamepad" : "Cancel");
  if (calibration !== null) write("hint", `${QUESTIONS[calibration.next]} (meanwhile, only Esc and the page's button stop)`);
}

let shownConditions = "";

function showNetwork(status) {
  byId("network").hidden = status.delay === null;
  if (status.delay === null) return;
  const names = status.conditions.map(([name]) => name).join();
  if (names !== shownConditions) {
    shownConditions = names;
    byId("conditions").replaceChildren(...status.conditions.map(([name, video, control]) => {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: name, title: `video ${video} ms, control ${control} ms` });
      Object.assign(button.dataset, { video, control });
      return button;
    }));
  }
  for (const button of byId("conditions").children) {
    const isChosen = Number(button.dataset.video) === status.delay[0] && Number(button.dataset.control) === status.delay[1];
    button.setAttribute("aria-pressed", isChosen);
  }
  ["video", "control"].forEach((flow, index) => {
    const slider = byId(`${flow}_delay`);
    if (document.activeElement !== slider) slider.value = status.delay[index];
    write(`${flow}_delay_ms`, `${status.delay[index].toFixed(0)} ms`);
  });
}
