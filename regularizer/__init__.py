"""Cube proposals, DSDS, visibility and clean(): everything applied to a density callable."""
