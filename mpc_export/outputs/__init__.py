"""Predictive control of the outputs of any exported model, kept inside limits that are tightened by
what the model is unsure of; `greybox mpc` flies models of the user's own with it."""
