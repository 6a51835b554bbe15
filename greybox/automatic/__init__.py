"""Right by default: what a user leaves open is decided from the flights, every choice with its
reason.

`fit` is the front door of Python as `greybox fit` is that of the command line; `decide` the
procedure, `greybox.estimation.recipe` what comes out of it.
"""

from __future__ import annotations

from greybox.automatic.front_door import fit

__all__ = ["fit"]
