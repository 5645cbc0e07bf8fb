"""Other programs with unghost plugged in."""
