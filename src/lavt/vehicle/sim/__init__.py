"""The built-in simulator: roads, a car's dynamics, a camera rendered on the CPU, and a judge."""
