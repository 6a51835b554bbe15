"""Models: parameters, vehicle, effects, sensors, the Newton-Euler core and its integration."""
