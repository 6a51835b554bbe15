"""How large a difference of BIC must be before one model is said to beat another."""

from __future__ import annotations

CLEAR = 10.0
"""BIC difference above which one model is said to beat another.

It stands for odds of about 150 to 1, which R. E. Kass and A. E. Raftery call very strong ("Bayes
factors", Journal of the American Statistical Association 90(430), 1995, section 3.2: BIC differs by
about twice the log of the odds).
"""

CLEAR_LOG_RATIO = CLEAR / 2
"""The same as a difference of log likelihoods between two models with equally many parameters."""

FELT = 3.0
"""Standard errors from which a parameter counts as felt."""
