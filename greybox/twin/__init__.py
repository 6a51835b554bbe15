"""The digital twin: an identified model as files of simulators, and what each of them leaves out."""
