# %% [markdown]
# # Physics, and what is left of it
# A model without drag misses a force. `gb.learn` learns it from the smoothed disturbances, with its uncertainty.

# %%
import greybox as gb

vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
names = ("B2_circle_fast_rep1", "B7_oval_fast_rep1", "B3_figure8_fast_rep1")
flights = gb.read_logs([gb.examples.flight_path("nanobench", n) for n in names], vehicle, rate=100)
train, test = flights.select(names[:2]), flights.select(names[2:])
# Columns that were smoothed with later samples must not enter a filter: `noncausal` names them.
model = gb.build_model(vehicle, train.channels, ["motor_lag"], sample_time=0.01, noncausal=train.noncausal)
physics = gb.fit(model, train, disturbance=["force", "torque"]).model

# %%
learned = gb.learn(physics, train, features=["body_velocity.x", "body_velocity.y", "body_velocity.z"], points=20)
print(learned.summary())

# %%
for name, m in (("physics", physics), ("with what was learned", learned.model)):
    print(name, gb.validate(m, test, horizons=(0.1, 0.5)).verdict.line)
gb.validate(learned.model, test, horizons=(0.1, 0.5)).plot()
