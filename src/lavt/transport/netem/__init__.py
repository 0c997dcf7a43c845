"""Delay by the Linux kernel: tc netem applied, verified and cleared."""
