// Which device drives: the one whose dead-man control is held.

export class Sources {
  #all;
  #resting;
  #used = null; // the device whose hold counts
  #spent = new Set(); // devices that were held while another one counted, and have not been released since

  // `resting()` returns the device whose values are shown and sent while no hold counts.
  constructor(all, resting) {
    this.#all = all;
    this.#resting = resting;
  }

  // Read the devices. When the hold that counts ends, nothing is held until a device is pressed after that.
  poll() {
    for (const device of this.#all) if (!device.holds) this.#spent.delete(device);
    const hasEnded = this.#used !== null && !this.#used.holds;
    if (hasEnded) this.#used = null;
    else this.#used ??= this.#all.find((device) => device.holds && !this.#spent.has(device)) ?? null;
    for (const device of this.#all) if (device.holds && device !== this.#used) this.#spent.add(device);
  }

  get holds() {
    return this.#used !== null;
  }

  get current() {
    return this.#used ?? this.#resting();
  }
}
