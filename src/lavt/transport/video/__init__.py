"""The video path: H.264, the stamp in the pixels, encryption and path validation."""
