"""How pictures and commands travel: steps 2 to 8 and 11 of the life of a frame."""
