"""Objects: their mesh in metres, their units, their own symmetry, and grids of rotations."""
