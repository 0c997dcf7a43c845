"""The clock offset between two machines: chrony, PTP and our own probe."""
