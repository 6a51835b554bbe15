"""Simulated vehicles in NumPy, independent of the equations in greybox.model.

They fly the demo of `greybox mpc` and the tests.
"""
