"""The processes of `video_vs_gstreamer.py` and `endurance.py`, and the code that both sides share."""
