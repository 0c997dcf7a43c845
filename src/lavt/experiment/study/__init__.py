"""Studies: the order of the conditions, the runs of the participants, and the answers about their workload."""
