"""Tube MPC: a controller that flies an identified model and keeps its constraints with a stated
probability."""
