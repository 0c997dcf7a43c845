"""Lane detection in pictures."""
