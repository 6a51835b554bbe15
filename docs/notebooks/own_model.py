# %% [markdown]
# # A model of your own
# Anything with states, inputs and outputs: here a mass on a spring, pushed. CasADi expressions, named parameters.

# %%
import numpy as np

import greybox as gb
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal

PLACE, SPEED = Signal(name="place", unit="m"), Signal(name="speed", unit="m/s")
spring = StateSpaceModel(
    name="spring",
    states=Layout([PLACE, SPEED]),
    inputs=Layout([Signal(name="push", unit="m/s^2")]),
    outputs=Layout([PLACE]),
    parameters=(
        Parameter(name="k", unit="1/s^2", nominal=20.0, lower=0.1, scale=10.0),
        Parameter(name="d", unit="1/s", nominal=1.0, lower=0.0, scale=0.5),
    ),
    dynamics=lambda t, x, u, p: [x[1], u[0] - p["k"] * x[0] - p["d"] * x[1]],
    measurement=lambda t, x, u, p: [x[0]],
    noise_states=("speed",),
    initial_sigma={"place": 0.1, "speed": 0.5},
    sensor_sigma={"place": 0.002},
)

# %% [markdown]
# The truth, simulated with steps of its own: k = 30, d = 0.6.

# %%
rng = np.random.default_rng(0)
t = 0.01 * np.arange(2000)
push = np.repeat(rng.uniform(-5, 5, 50), 40)
place, speed, rows = 0.0, 0.0, []
for u in push:
    rows.append(place + 0.002 * rng.standard_normal())
    for _ in range(20):
        place, speed = place + 5e-4 * speed, speed + 5e-4 * (u - 30 * place - 0.6 * speed)
data = gb.dataset_from_arrays(t, {"push": push, "place": np.array(rows)}, name="bench")
data.plot(["push", "place"])

# %%
train, test = data.split_by_time(0.6)
fit = gb.fit(spring, train)
print({name: round(p.value, 3) for name, p in fit.parameters.items()})
assert abs(fit.parameters["k"].value - 30) < 4 * fit.parameters["k"].std
gb.validate(fit.model, test).plot()
