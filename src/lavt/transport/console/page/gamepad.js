// Input from a gamepad, or from a wheel with pedals after a calibration.
//
// A calibration names, for each control, a button, or an axis with its values at rest and at full deflection. This
// browser keeps it by the device's id. A gamepad that the browser knows (mapping "standard") needs none.

import { limit } from "./hand.js";

const STORE = "lavt calibration: ";
const DEAD_ZONE = 0.06; // share of the way, at rest
const AT_REST = 0.1; // a pedal with a smaller deflection is at rest
const MOVED = 0.7; // change of an axis with which a person answers a question of the calibration
const PRESSED = 0.5;
const STANDARD = {
  left: { axis: 0, rest: 0, full: -1 },
  right: { axis: 0, rest: 0, full: 1 },
  throttle: { button: 7 },
  brake: { button: 6 },
  hold: { button: 5 },
  stop: { button: 1 },
};
const BUTTONS_ONLY = ["hold", "stop"];

export const QUESTIONS = {
  left: "turn fully to the left, then release it",
  right: "turn fully to the right, then release it",
  throttle: "press the throttle fully, then release it",
  brake: "press the brake fully, then release it",
  hold: "press and release the button that you will hold to drive",
  stop: "press and release the button for the emergency stop",
};

export class Gamepads {
  #rested = new Set(); // pedals and dead-man control, once they have been at rest since the device was connected
  #wasStopped = false;
  #stop;
  #index = null; // of the device in use; two devices may have the same id
  #isGone = false; // it was disconnected since the last `poll`

  // `stop()` is called when the button for the emergency stop is pressed.
  constructor(stop) {
    this.#stop = stop;
    this.id = ""; // of the device in use; empty: none
    this.lost = false; // at this `poll`, the device in use was gone
    this.holds = false;
    this.steering = 0; // -1 to 1, left positive
    this.throttle = 0;
    this.brake = 0;
    addEventListener("gamepaddisconnected", ({ gamepad }) => {
      if (gamepad.index === this.#index) this.#isGone = true;
    });
  }

  // Read the first device that needs no calibration, or has one.
  poll() {
    const device = devices().find((candidate) => calibrationOf(candidate) !== null) ?? null;
    const isOther = this.#isGone || device?.id !== this.id || device?.index !== this.#index;
    this.lost = this.id !== "" && isOther;
    if (isOther) this.#rested.clear();
    this.id = device?.id ?? "";
    this.#index = device?.index ?? null;
    this.#isGone = false;
    this.holds = false;
    this.steering = this.throttle = this.brake = 0;
    if (device === null) return;
    const calibration = calibrationOf(device);
    this.steering = beyondDeadZone(deflection(device, calibration.left) - deflection(device, calibration.right));
    this.throttle = this.#pedal(device, calibration, "throttle");
    this.brake = this.#pedal(device, calibration, "brake");
    const holds = deflection(device, calibration.hold) > PRESSED;
    if (!holds) this.#rested.add("hold");
    this.holds = holds && this.#rested.has("hold"); // a button that was held when the device came is no decision
    const stops = deflection(device, calibration.stop) > PRESSED;
    if (stops && !this.#wasStopped) this.#stop();
    this.#wasStopped = stops;
  }

  // A calibration has ended: the button that has answered its last question stops only when it is pressed again.
  endCalibration() {
    this.#wasStopped = true;
  }

  // A pedal that has not moved since the page was loaded reads the middle of its way, so it must have been at rest.
  #pedal(device, calibration, name) {
    const value = deflection(device, calibration[name]);
    if (value < AT_REST) this.#rested.add(name);
    return this.#rested.has(name) ? beyondDeadZone(value) : 0;
  }
}

// The questions to the person, and the controls that answered them.
export class Calibration {
  #device = null; // id of the device that answered the first question
  #rests = new Map(); // by device id: the values at the beginning
  #found = {};
  #isReleased = true;

  constructor() {
    for (const device of devices()) {
      this.#rests.set(device.id, { axes: [...device.axes], buttons: device.buttons.map(({ value }) => value) });
    }
  }

  // The control that is asked for; null: the calibration is complete, and saved.
  get next() {
    return Object.keys(QUESTIONS).find((name) => !(name in this.#found)) ?? null;
  }

  // Read the devices, and note the answer if there is one. A control must be released before the next one counts.
  poll() {
    if (this.next === null) return;
    const answers = devices()
      .filter(({ id }) => this.#rests.has(id) && (this.#device === null || this.#device === id))
      .map((device) => [device, this.#moved(device)])
      .filter(([, control]) => control !== null);
    if (answers.length === 0) {
      this.#isReleased = true;
      return;
    }
    const [device, control] = answers[0];
    if (!this.#isReleased || this.#isUsed(control)) return;
    this.#isReleased = false;
    this.#device = device.id;
    this.#found[this.next] = control;
    if (this.next === null) localStorage.setItem(STORE + device.id, JSON.stringify(this.#found));
  }

  // The axis or button that has been moved; null: none.
  #moved(device) {
    const rest = this.#rests.get(device.id);
    if (!BUTTONS_ONLY.includes(this.next)) {
      const ways = device.axes.map((value, axis) => Math.abs(value - rest.axes[axis]));
      const axis = ways.indexOf(Math.max(...ways));
      if (ways[axis] > MOVED) {
        return { axis, rest: rest.axes[axis], full: Math.sign(device.axes[axis] - rest.axes[axis]) };
      }
    }
    const button = device.buttons.findIndex(({ value }, index) => value > PRESSED && rest.buttons[index] < PRESSED);
    return button < 0 ? null : { button };
  }

  #isUsed(control) {
    return Object.values(this.#found).some((other) => JSON.stringify(other) === JSON.stringify(control));
  }
}

export function devices() {
  return [...navigator.getGamepads()].filter((device) => device !== null && device.connected);
}

function calibrationOf(device) {
  try {
    const saved = JSON.parse(localStorage.getItem(STORE + device.id));
    if (saved !== null && Object.keys(QUESTIONS).every((name) => typeof saved[name] === "object")) return saved;
  } catch {
    localStorage.removeItem(STORE + device.id);
  }
  return device.mapping === "standard" ? STANDARD : null;
}

// How far a control has been moved, 0 to 1.
function deflection(device, { axis, rest, full, button }) {
  const value = button === undefined ? (device.axes[axis] - rest) / (full - rest) : device.buttons[button]?.value;
  return Number.isFinite(value) ? limit(value, 0, 1) : 0;
}

function beyondDeadZone(value) {
  const size = Math.abs(value);
  return size <= DEAD_ZONE ? 0 : (Math.sign(value) * (size - DEAD_ZONE)) / (1 - DEAD_ZONE);
}
