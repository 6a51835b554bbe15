"""Laws: what is left of force and torque as a sum of a few terms, where such a sum foretells it."""
