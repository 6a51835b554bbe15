"""Sensors: one file is one sensor."""
