"""Criteria: one file is one member."""
