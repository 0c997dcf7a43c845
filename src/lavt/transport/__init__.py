"""Transport of video, commands and states between vehicle and operator: steps 2 to 8 and 11 of the life of a frame."""
