"""Safety on the vehicle: sessions, limits, the command gate, the watchdog and the path followed without commands."""
