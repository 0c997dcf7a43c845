"""What `lavt doctor` checks on a machine, and how it finds out."""
