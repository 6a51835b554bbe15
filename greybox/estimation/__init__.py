"""Estimation: predictor x criterion x solver x initialisation, on any Dynamics."""
