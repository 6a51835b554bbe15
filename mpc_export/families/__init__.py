"""Families of exported functions: each adds its own to the functions of one model."""
