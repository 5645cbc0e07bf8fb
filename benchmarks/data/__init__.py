"""Making cubes: speed, corruptions, and the harvest."""
