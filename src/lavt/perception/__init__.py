"""From a picture to a lane: step 9 of the life of a frame."""
