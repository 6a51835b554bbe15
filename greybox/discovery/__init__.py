"""Discovery: find where simulation and data disagree, name the missing effect, add it, verify."""
