"""Studies: one file tells one story."""
