"""Density fields and synthetic scenes. Importing this package needs numpy only; radiance fields need torch."""
