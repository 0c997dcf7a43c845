"""Frames on their way: H.264, the stamp in the pixels, encryption and path validation."""
