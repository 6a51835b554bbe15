"""Linear state-space identification: subspace start, prediction error polish, order,
uncertainty."""
