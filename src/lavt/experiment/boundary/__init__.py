"""The search for the maximum tolerable latency, and the theory it is compared with."""
