# %% [markdown]
# # Out to acados
# A bundle holds the model as C and CasADi, a verifier, and adapters for controllers (docs/consumers.md).

# %%
import subprocess
import sys

import greybox as gb

vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
flight = gb.read_logs([gb.examples.flight_path("nanobench", "B2_circle_fast_rep1")], vehicle, rate=100)
model = gb.build_model(vehicle, flight.channels, ["motor_lag"], sample_time=0.01)
fit = gb.fit(model, flight)
folder = gb.export(fit.model, "craft", name="craft", targets=("c", "casadi", "acados"))
sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*.py"))

# %% [markdown]
# The verifier compiles the C and holds it against recorded numbers, without greybox.

# %%
verify = [sys.executable, "-m", "mpc_export.verify", str(folder)]
done = subprocess.run(verify, capture_output=True, text=True, check=True)  # raises where anything differs
print(done.stdout[-300:])

# %% [markdown]
# With acados installed: `python craft/examples/acados_hover.py --acados DIR`. The step answers to CasADi alone, too:

# %%
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(folder / "python"))
import rebuild

step = rebuild.load()["f_d"]
x, u = fit.model.reference_state, fit.model.reference_inputs
path = [np.array(x)]
for _ in range(50):
    path.append(step(path[-1], u * 1.05, fit.model.parameter_vector()[: step.size1_in(2)]).full().ravel())
plt.plot(0.01 * np.arange(51), np.array(path)[:, 2])
plt.xlabel("time [s]")
plt.ylabel("height at 5 % more command [m]")
