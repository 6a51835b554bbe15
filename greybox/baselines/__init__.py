"""Rivals of the hybrid and the fair comparison of all: linear models with a learned output
residual, NARX, LSTM."""
