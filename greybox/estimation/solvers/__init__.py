"""Solvers: one file is one member."""
