"""Craft of foreign simulators: RotorPy, MuJoCo and drone-models fly what greybox is judged on
(extra `judge`)."""
