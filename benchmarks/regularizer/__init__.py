"""Cost and effect of the regularizer, and its numerical stability."""
