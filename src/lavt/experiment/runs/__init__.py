"""Single runs: planned, driven in real or virtual time, and joined from the records of both sides."""
