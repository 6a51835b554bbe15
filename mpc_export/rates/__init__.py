"""The paper's idea flown: a rate controller on an identified linear model with a Gaussian process
on its output residual.

An outer loop asks for body rates and a thrust; `RateController` plans rotor commands that follow
them inside rate limits, which it tightens by the variance that the exported predictor carries
ahead. `greybox mpc rates` is its command.
"""
