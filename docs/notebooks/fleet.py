# %% [markdown]
# # A fleet: one model, flights of many days
# What every flight has of its own (biases, a wind) is `per_flight`; what belongs to the craft is shared.

# %%
import matplotlib.pyplot as plt

import greybox as gb

vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
folder = gb.examples.flight_path("nanobench", "B2_circle_fast_rep1").parent
paths = sorted(folder.glob("B*.gz"))[:6]
flights = gb.read_logs(paths, vehicle, rate=50)
print(flights)

# %%
model = gb.build_model(vehicle, flights.channels, ["motor_lag", "gyro_bias"], sample_time=0.02)
fit = gb.fit(model, flights)
shared = {n: round(p.value, 6) for n, p in fit.parameters.items() if not p.per_flight}
print(shared)

# %%
own = {n: p.per_flight for n, p in fit.parameters.items() if p.per_flight}
name, values = next(iter(own.items()))
middle, std = zip(*values.values())
plt.errorbar(range(len(values)), middle, [1.96 * s for s in std], fmt="o")  # 95 % intervals
plt.xticks(range(len(values)), list(values), rotation=40, ha="right", fontsize=7)
plt.ylabel(name)
plt.tight_layout()
