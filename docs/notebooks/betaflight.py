# %% [markdown]
# # A blackbox log of Betaflight
# There is no position in it, and before 2025.12 no attitude. Rates and accelerometer are enough for the rotational half.

# %%
import greybox as gb
from greybox.data.inspection import inspect_log

LOG, VEHICLE = "flight.bbl", "vehicle.toml"
vehicle = gb.read_vehicle(VEHICLE)
inspect_log(LOG, vehicle)

# %%
flight = gb.read_logs([LOG], vehicle, rate=100)
flight.plot(["p", "q", "r"])

# %% [markdown]
# How do the rates answer the mixed commands, and how soon?

# %%
response = gb.frf(flight, ["roll", "pitch"], ["p", "q"], vehicle=vehicle)
response.plot("p/roll")

# %%
model = gb.build_model(vehicle, flight.channels, ["motor_lag"], sample_time=0.01)
fit = gb.fit(model, flight, fixed=["mass"])
fit.plot_residuals()
