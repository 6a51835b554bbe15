"""Flight data: channels, segments, data sets, log readers, conditioning and the data-fault
checks."""

from greybox.data.arrays import dataset_from_arrays
from greybox.data.channel import Channel, channel, group_names
from greybox.data.dataset import Dataset, Flight
from greybox.data.logs import RawLog, read_log, read_logs, read_table
from greybox.data.segment import Segment

__all__ = [
    "Channel",
    "Dataset",
    "Flight",
    "RawLog",
    "Segment",
    "channel",
    "dataset_from_arrays",
    "group_names",
    "read_log",
    "read_logs",
    "read_table",
]
