"""The two measuring processes of `control_round_trip.py`, and the carriers of messages between the two."""
