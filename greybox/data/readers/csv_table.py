"""Logs that are tables of text, plain or gzip, of any column names (see `greybox.data.logs.csv`)."""

from __future__ import annotations

from greybox.data.logs.csv import read_csv
from greybox.data.readers.recording import LogFormat

FORMAT = LogFormat(
    name="csv",
    title="table of text",
    endings=(".csv", ".csv.gz"),
    table=read_csv,
    advice={
        "": "columns have the names, units and frames of docs/files.md, or a mapping file says "
        "which they are"
    },
)
