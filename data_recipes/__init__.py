"""Cube recipes: procedural and mesh cubes, corruptions, harvested pairs."""
