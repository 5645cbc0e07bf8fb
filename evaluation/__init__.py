"""The two-trajectory protocol: captures, masks, metrics."""
