"""The runtimes that run the nodes, in real or in virtual time."""
