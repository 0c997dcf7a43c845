"""Maps in the format ASAM OpenDRIVE: reading, geometry of lanes, and routes along lanes."""
