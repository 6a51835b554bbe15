"""What an animation of a flight needs of the plans that were made in it."""

from __future__ import annotations

import numpy as np

from greybox.report.mpc_documents import PlanTrace
from mpc_export.tube.controller import TubeController
from mpc_export.tube.stages import block

SHOWN_STAGES = 11
"""How many stages of a plan an animation shows."""


class Trace:
    """Plans of a flight, thinned: where each stage is expected, how unsure that is, how far the
    limit is."""

    def __init__(self, pilot: TubeController, horizon: int) -> None:
        self.place = block(pilot.functions, "position")
        self.stages = np.unique(np.linspace(0, horizon, SHOWN_STAGES).round().astype(int))
        self.functions = pilot.functions
        self.learned = "gp_variance" in pilot.functions.functions
        self.plans: list[PlanTrace] = []
        self.count = 0

    def look(self, pilot: TubeController) -> None:
        """Keep every second plan: stages' times from now, positions, covariances (xx, xy, xz, yy,
        yz, zz), distance to the nearest plane and its back-off, the learned part's standard
        deviation, and how far outside the training data."""
        self.count += 1
        if self.count % 2 == 0 or pilot.plan is None:
            return
        data, plan, f = pilot.solver.data, pilot.plan, self.functions
        planes = data["plane"]
        left = planes[..., 3] - np.einsum("kji,ki->kj", planes[..., :3], plan.x[:, self.place])
        left = np.where((planes[..., :3] ** 2).sum(axis=-1) > 0, left, np.inf)
        first = left.argmin(axis=1)
        rows = np.arange(len(left))
        spread = data["covariance"][:, self.place][:, :, self.place][self.stages]
        upper = np.triu_indices(3)
        x, u, p = plan.x[0], plan.u[0], pilot.p
        unsure: list[float] = []
        if self.learned:
            z = f["gp_features"](x, u, p)[0]
            unsure = np.sqrt(np.maximum(f["gp_variance"](z, p).full().ravel(), 0.0)).tolist()
        far = float(f["out_of_domain"](x, u, p)[0]) if "out_of_domain" in f.functions else 0.0
        self.plans.append(
            {
                "time": round(plan.time, 3),
                "place": np.round(plan.x[self.stages][:, self.place], 4).tolist(),
                "spread": [[float(f"{v:.3g}") for v in s[upper]] for s in spread],
                "left": np.round(left[rows, first], 4)[self.stages].tolist(),
                "backoff": np.round(data["backoff"][rows, first], 4)[self.stages].tolist(),
                "unsure": [float(f"{v:.3g}") for v in unsure],
                "outside": round(far, 3),
            }
        )
