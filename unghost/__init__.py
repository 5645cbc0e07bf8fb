"""unghost."""
