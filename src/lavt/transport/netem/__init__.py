"""Delay and other impairments by the Linux kernel: tc netem is applied, verified and cleared."""
