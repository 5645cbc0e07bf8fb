"""Cost and effect of ``clean``, on fields and on splats."""
