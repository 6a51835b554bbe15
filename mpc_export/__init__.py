"""Export of fitted models for controllers."""
