"""The search for the maximum tolerable latency, and the theoretical delay margin for comparison."""
