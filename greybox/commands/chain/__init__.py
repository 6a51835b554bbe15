"""The chain behind `greybox identify`: plain commands one after the other, each with the folder of
the one before, kept on disk so that a chain that was stopped goes on where it was.

`stages` lists them, `run` runs them, `record` keeps what is done, `choice` says which model comes
out, `left` how long it will take, `guess` makes a vehicle file, `front_door` is `greybox.identify`.
"""
