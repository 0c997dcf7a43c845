"""The processes of `control_round_trip.py`: who asks, who echoes, and what carries a message between them."""
