"""Single runs: planning, driving in real or virtual time, and joining the records of two machines."""
