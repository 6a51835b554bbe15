"""Flights as data: channels, segments, data sets, conditioning and the data-fault gate."""
