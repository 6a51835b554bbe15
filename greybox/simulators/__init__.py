"""The digital twin: a model as files of simulators, and what each of them leaves out."""
