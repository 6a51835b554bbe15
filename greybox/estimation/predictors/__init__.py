"""Predictors: one file is one member."""
