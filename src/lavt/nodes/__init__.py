"""The parts of the loop, each a table of hops without input, output or clock."""
