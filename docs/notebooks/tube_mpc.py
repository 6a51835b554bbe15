# %% [markdown]
# # A tube around a plan
# The controller plans with the identified model and stays away from limits by what the model does not know.

# %%
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np

import greybox as gb
from mpc_export.tube.controller import TubeController
from mpc_export.tube.problem import TubeProblem

vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
flight = gb.read_logs([gb.examples.flight_path("nanobench", "B2_circle_fast_rep1")], vehicle, rate=100)
model = gb.build_model(vehicle, flight.channels, ["motor_lag"], sample_time=0.01)
found = gb.fit(model, flight, disturbance=["force", "torque"]).model

# %% [markdown]
# Hold a place, at most 50 ms of a plan each 20 ms; the plant is the model itself, pushed along x.

# %%


class Hover:
    """Stay at one metre."""

    def sample(self, time):
        """Reference at `time` (n,)."""
        n = len(time)
        place = np.tile([0.0, 0.0, 1.0], (n, 1))
        return SimpleNamespace(position=place, velocity=0 * place, acceleration=0 * place, yaw=np.zeros(n))


pilot = TubeController(
    model=found, problem=TubeProblem(dt=0.02, horizon=8, planes=2, rate_max=0.05), reference=Hover(),
    kappa=(2.0, 2.0, 2.0), kappa_u=1.0,
)  # fmt: skip
pilot.start()
functions, u = pilot.filter, pilot.u
x, names, path = pilot.estimate.copy(), pilot.filter.states.names, []
for k in range(300):
    x[names.index("disturbance.force.x")] = 0.1 * 9.81 * found.values["mass"]
    y = functions["h"](x, u, functions.parameter_values).full().ravel()
    new = pilot.sample(0.01 * k, dict(zip(functions.outputs.names, y.tolist())))
    x = functions["f_d"](x, u, functions.parameter_values).full().ravel()
    path.append(x[:3])
    u = new

# %%
plt.plot(0.01 * np.arange(300), 100 * np.array(path))
plt.legend(["x", "y", "z"])
plt.xlabel("time [s]")
plt.ylabel("place [cm]")
assert np.abs(np.array(path)[-1] - [0, 0, 1]).max() < 0.01  # the push leaves no offset
