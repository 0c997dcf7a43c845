"""Safety on the vehicle: sessions, limits, the command gate, the watchdog, and path following without commands."""
