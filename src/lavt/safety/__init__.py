"""The safety gate of the vehicle: sessions, limits, the command gate and the path followed without commands."""
