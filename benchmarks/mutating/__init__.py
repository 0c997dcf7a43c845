"""The parts of `benchmarks/mutation.py`: the sites of mutations, the trials of mutants, and the report."""
