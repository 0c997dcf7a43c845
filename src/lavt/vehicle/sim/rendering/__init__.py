"""The camera of the built-in simulator, rendered on the CPU."""
