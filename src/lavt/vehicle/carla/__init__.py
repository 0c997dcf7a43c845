"""A vehicle in a CARLA server, through the package `carla`; no real server was ever used."""
