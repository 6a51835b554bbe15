"""Grey-box identification of small multirotors: physics by the prediction error method."""
