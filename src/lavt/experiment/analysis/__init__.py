"""What is computed from the records of one run."""
