# %% [markdown]
# # A log of PX4
# Put your `.ulg` file beside this notebook and say its name. `inspect_log` says what is usable and what to log.

# %%
import greybox as gb
from greybox.data.inspection import inspect_log

LOG, VEHICLE = "flight.ulg", "vehicle.toml"  # greybox vehicle new --from flight.ulg --out vehicle.toml
vehicle = gb.read_vehicle(VEHICLE)
inspect_log(LOG, vehicle)

# %%
flight = gb.read_logs([LOG], vehicle, rate=100)
flight.plot(["u1", "u2", "u3", "u4"])
gb.check(flight, vehicle)

# %% [markdown]
# One flight: the first two thirds are fitted, the rest judges.

# %%
train, test = flight.split_by_time(0.66)
model = gb.build_model(vehicle, train.channels, ["motor_lag"], sample_time=0.01)
fit = gb.fit(model, train)
seen = gb.validate(fit.model, test, horizons=(0.1, 0.5))
print(seen.verdict.line)
seen.plot()
