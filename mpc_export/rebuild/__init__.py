"""What an export bundle carries in its python/ folder: an interpreter that needs casadi and numpy
and nothing of greybox."""
