"""The processes of `video_vs_gstreamer.py` and `endurance.py`, and what both sides share."""
