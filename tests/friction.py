"""An effect file of a user: rate damping, which the catalogue has under another name."""

FRICTION = """
import casadi as ca
from greybox.model.effect import Effect, vector_parameters

class Friction(Effect):
    name = "friction"
    stage = "wrench"
    summary = "rate damping under another name"
    formula = "tau = -d omega"
    references = ("Doe 2024, Friction of air",)

    def parameters(self, vehicle):
        return vector_parameters("d_", "pqr", unit="N m s", scale=1e-3, meaning="damping", lower=0.0)

    def apply(self, flow, p):
        return {"moment": -ca.vertcat(p["d_p"], p["d_q"], p["d_r"]) * flow.omega}
"""
