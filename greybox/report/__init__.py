"""Reports: one self-contained HTML file that a person likes to read, built from plain data."""
