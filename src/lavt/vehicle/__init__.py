"""Vehicles and their cameras: the first and the last step of the life of a frame."""
