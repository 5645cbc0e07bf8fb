"""Fixtures and helpers that several folders of tests share; loaded as plugins by ``tests/conftest.py``."""
