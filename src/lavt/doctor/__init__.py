"""The checks of `lavt doctor` and `lavt clock`, and the measurements of a machine on which the checks are based."""
