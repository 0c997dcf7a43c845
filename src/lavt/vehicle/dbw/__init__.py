"""Drive-by-wire on CAN: messages and their CRC (`docs/can.md`)."""
