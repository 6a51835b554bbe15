"""Simulated plants in NumPy, independent of greybox's equations."""
