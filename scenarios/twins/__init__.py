"""Twins: simulators of others fly the files that greybox wrote."""
