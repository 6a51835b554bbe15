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

    def mean(self, z: Expr) -> Expr:
        """Posterior mean (n_out, 1) in output units at z (n_in, 1), for SX, MX, DM or plain
        numbers."""
        return self.expressions(z, ("mean",))["mean"]

    def variance(self, z: Expr, noise: bool | str = False) -> Expr:
        """Variance (n_out, 1) in output units squared: of the function; with `noise` of a new
        measured sample.

        `noise` may also be the name of a group (flight) whose own noise level counts. Never
        negative.
        """
        return self.expressions(z, ("variance",), noise=noise)["variance"]

    def mean_jacobian(self, z: Expr) -> Expr:
        """d mean/dz (n_out, n_in), analytic."""
        return self.expressions(z, ("mean_jacobian",))["mean_jacobian"]

    def variance_jacobian(self, z: Expr) -> Expr:
        """d variance/dz (n_out, n_in), analytic; the noise is constant and does not count."""
        return self.expressions(z, ("variance_jacobian",))["variance_jacobian"]

    def distance(self, z: Expr) -> Expr:
        """How far z is from the training data, a scalar in [0, 1]: 0 where these determine the
        function, 1 where they say nothing, as everywhere without active outputs. Of a Gaussian
        process the largest share of a prior variance that the support points leave unexplained."""
        return self.expressions(z, ("distance",))["distance"]

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
