"""The lane keeping controller: from a detected lane and a speed to steering and pedals."""
