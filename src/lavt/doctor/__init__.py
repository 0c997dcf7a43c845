"""The checks of `lavt doctor`, and the probes that measure a machine for them."""
