"""Lane detection in pictures: step 9 of the life of a frame."""
