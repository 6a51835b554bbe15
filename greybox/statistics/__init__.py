"""Statistics of arrays, without flights, models or fits: whiteness, chi-square, evidence."""
