"""Benchmarks: run each as ``python -m benchmarks.FOLDER.NAME`` from the project's root."""
