"""The learned prior: network, training, checkpoints (torch)."""
