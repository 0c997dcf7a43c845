"""The parts of `benchmarks/mutation.py`: sites where sources can be mutated, trials of mutants, and the report."""
