"""The adapter for drive-by-wire kits on CAN, with their messages (`docs/can.md`)."""
