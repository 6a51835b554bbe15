"""Targets of an export that fly: what each adds to a bundle around `pilot_step`. One file per
target."""
