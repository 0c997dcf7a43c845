"""Estimates of the clock offset between two machines: by chrony, by PTP and by a probe."""
