"""Validation: metrics, residual tests, multi-step errors."""
