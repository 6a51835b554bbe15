"""Effects: one file is one effect; the catalogue tuple lists them."""
