# %% [markdown]
# # An effect of your own
# One class in a file: here a cable that pulls to the ground. docs/own_effect.md says what every line means.

# %%
from pathlib import Path

import greybox as gb
from greybox.model.effects_file import load_effects

Path("tether.py").write_text('''
import casadi as ca

from greybox.model.effect import Effect
from greybox.model.parameter import Parameter


class Tether(Effect):
    name = "tether"
    stage = "wrench"
    summary = "weight of a cable that hangs from the craft to the ground"
    formula = "F = -w z e_z (world)"

    def parameters(self, vehicle):
        return (Parameter(name="w", unit="N/m", nominal=0.0, null=0.0, scale=0.1, meaning="weight of a metre"),)

    def apply(self, flow, p):
        return {"force": flow.rotation.T @ ca.vertcat(0, 0, -p["w"] * flow.position[2])}
''')
(tether,) = load_effects("tether.py")

# %% [markdown]
# Fitted like any other. No cable hung there: zero lies within two standard errors or the estimate is a trace.

# %%
vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
flight = gb.read_logs([gb.examples.flight_path("nanobench", "B5_helix_medium_rep2")], vehicle, rate=100)
flight.plot(["z"])

# %%
model = gb.build_model(vehicle, flight.channels, ["motor_lag", tether], sample_time=0.01)
fit = gb.fit(model, flight)
estimate = fit.parameters["tether.w"]
print(f"{estimate.value:.4f} N/m, standard error {estimate.std or float('nan'):.4f}")
fit.plot()
