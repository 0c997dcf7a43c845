"""The checks of `lavt doctor` and `lavt clock`, and the measurements of a machine that they judge."""
