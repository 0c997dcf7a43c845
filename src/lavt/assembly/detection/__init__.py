"""The construction of lane detectors by name."""
