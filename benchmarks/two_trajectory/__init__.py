"""Trained on one sweep of photos, scored on another."""
