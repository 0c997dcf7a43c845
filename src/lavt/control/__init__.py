"""From a lane to a command, and which commands a vehicle obeys: steps 10 and 12."""
