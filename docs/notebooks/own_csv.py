# %% [markdown]
# # Columns of your own
# Any table becomes flights: one array per channel, in SI units, x forward, y left, z up (docs/conventions.md).

# %%
import numpy as np

import greybox as gb

raw = np.genfromtxt(gb.examples.flight_path("nanobench", "B2_circle_fast_rep1"), delimiter=",", names=True)
print(raw.dtype.names[:8])

# %% [markdown]
# Tables `[columns.GROUP]` of the vehicle file say which columns are which channels; `read_logs` takes the file as it is.

# %%
vehicle = gb.read_vehicle(gb.examples.vehicle_path("nanobench"))
flight = gb.read_logs([gb.examples.flight_path("nanobench", "B2_circle_fast_rep1")], vehicle, rate=100)
flight.plot(["x", "y", "z"])

# %% [markdown]
# Arrays that are in memory need no file.

# %%
segment = flight.flights[0].segments[0]
again = gb.dataset_from_arrays(segment.t, dict(segment.channels), name="from arrays")
assert again.channels == flight.channels
gb.check(again, vehicle)
