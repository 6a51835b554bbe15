# %% [markdown]
# # A Crazyflie, from its SD card
# Three flights at 1 kHz come along (`gb.examples`). Two are fitted, one judges.

# %%
import greybox as gb

paths = [gb.examples.flight_path("arpl_crazyflie", f"log{k}") for k in (10, 15, 16)]
vehicle = gb.read_vehicle(gb.examples.vehicle_path("arpl_crazyflie"))
flights = gb.read_logs(paths, vehicle, rate=100)
flights

# %%
report = gb.check(flights, vehicle)
print(report.verdict)
flights.plot(["p", "q", "r"])

# %% [markdown]
# `gb.fit(vehicle, train, test=test)` decides all that is open, in about a minute. Here the choices are said.

# %%
train, test = flights.select(["log10", "log15"]), flights.select(["log16"])
model = gb.build_model(vehicle, train.channels, ["motor_lag", "command_delay"], sample_time=0.01)
fit = gb.fit(model, train)
fit.plot()

# %%
seen = gb.validate(fit.model, test, horizons=(0.1, 0.3))
print(seen.verdict.line)
seen.plot()
