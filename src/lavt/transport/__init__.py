"""Transport of video, commands and states between the vehicle and the operator."""
