"""The parts of `benchmarks/mutation.py`: sites of mutations, trees in which they run, and the report."""
