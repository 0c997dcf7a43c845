"""A vehicle in a CARLA server, through the wheel `carla`; no real server was ever used."""
