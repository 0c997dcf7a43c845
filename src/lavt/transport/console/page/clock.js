// The page's clock, and its offset to the client's wall clock from probes over the socket, as in NTP.

const PROBES = 16; // of which the one with the shortest round trip counts
const STEP_US = 1000; // a change beyond the errors of both probes plus this is a step of a clock

export function pageTime_us() {
  return Math.round((performance.timeOrigin + performance.now()) * 1000);
}

export class Offset {
  #probes = [];

  // Note an answer: `sent_us` is of the page's clock, the other two of the client's.
  note({ sent_us, received_us, answered_us }, arrived_us = pageTime_us()) {
    const round_trip_us = arrived_us - sent_us - (answered_us - received_us);
    if (round_trip_us < 0) return;
    const probe = { offset_us: (received_us - sent_us + (answered_us - arrived_us)) / 2, bound_us: round_trip_us / 2 };
    const best = this.best;
    if (best !== null && Math.abs(best.offset_us - probe.offset_us) > best.bound_us + probe.bound_us + STEP_US) {
      this.#probes = [];
    }
    this.#probes = [...this.#probes, probe].slice(-PROBES);
  }

  // The offset `client minus page` with its bound; null before the first answer.
  get best() {
    return this.#probes.reduce((best, probe) => (best === null || probe.bound_us < best.bound_us ? probe : best), null);
  }
}
