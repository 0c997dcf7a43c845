"""The parts of `benchmarks/mutation.py`: where a module can be mutated, in which tree it is tried, and the report."""
