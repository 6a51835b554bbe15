"""AsFunction: what follows from a learned part's `expressions`, whatever it was learned by."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import ClassVar

import casadi as ca

from greybox.symbolic import Expr, Layout


class AsFunction:
    """CasADi functions of a learned part with `inputs` and `expressions`."""

    called: ClassVar[str] = "gp"
    """Name of a function that is given none."""
    inputs: Layout

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Several quantities of one z (n_in, 1)."""
        raise NotImplementedError

    def function(
        self,
        name: str | None = None,
        which: Iterable[str] = ("mean", "variance"),
        *,
        noise: bool | str = False,
        symbol: type[ca.SX] | type[ca.MX] = ca.MX,
    ) -> ca.Function:
        """A CasADi function z -> the quantities in `which` (named in- and outputs); `symbol` is
        casadi.MX or casadi.SX."""
        names = list(which)
        z: Expr = symbol.sym("z", len(self.inputs))
        values = self.expressions(z, names, noise=noise)
        return ca.Function(
            name or self.called, [z], [ca.densify(values[n]) for n in names], ["z"], names
        )

    @cached_property
    def _moments(self) -> ca.Function:
        z = ca.MX.sym("z", len(self.inputs))
        values = self.expressions(z, ("mean", "variance"))
        return ca.Function(
            "moments", [z], [ca.densify(ca.vertcat(values["mean"], values["variance"]))]
        )

    @cached_property
    def _distance(self) -> ca.Function:
        return self.function("distance", ("distance",))
