"""Vehicles and their cameras: the first and the last stage in the life of a frame."""
