"""The built-in simulator: roads, vehicle dynamics, a camera rendered on the CPU, and a route monitor."""
