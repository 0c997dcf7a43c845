"""The processes of `video_vs_gstreamer.py` and `endurance.py`, and the code that LAVT's and GStreamer's share."""
