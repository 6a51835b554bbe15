"""Excitation designs, one file each."""
