"""Decoupled linear models: several as one, and the parts of one that do not touch each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg as sla

from greybox.errors import ModelError
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.symbolic import FloatArray, Layout

Terms = tuple[tuple[float, str], ...]
"""(weight, log column) of a sum that is an input."""


def combined(
    models: Sequence[LinearModel], channels: Mapping[str, Terms]
) -> tuple[LinearModel, dict[str, Terms]]:
    """Decoupled linear models as one, block by block, and the log columns of its inputs.

    An input that several models share appears once per model, as "roll.ay" for the model of output
    ay, because delay and operating point belong to the model. Raises `ModelError` for models that
    predict the same output or differ in `dt`.
    """
    if len(models) == 1:
        return models[0], dict(channels)
    names = [n for m in models for n in m.outputs.names]
    if len(set(names)) != len(names) or len({m.dt for m in models}) > 1:
        raise ModelError(
            "linear models that do not fit together", expected="different outputs, one sample time"
        )
    often = [n for m in models for n in m.inputs.names]
    inputs, terms = [], dict(channels)
    for m in models:
        for s in m.inputs:
            name = f"{s.name}.{'.'.join(m.outputs.names)}" if often.count(s.name) > 1 else s.name
            terms[name] = channels.get(s.name, ((1.0, s.name),))
            inputs.append(replace(s, name=name))
    blocks = [sla.block_diag(*(m.matrices[i] for m in models)) for i in range(5)]
    whole = LinearModel(
        name=", ".join(m.name for m in models),
        matrices=Matrices(*blocks),
        noise=sla.block_diag(*(m.noise for m in models)),
        dt=models[0].dt,
        inputs=Layout(inputs),
        outputs=Layout([s for m in models for s in m.outputs]),
        delays=tuple(d for m in models for d in m.delays),
        input_offset=np.concatenate([m.input_offset for m in models]),
        output_offset=np.concatenate([m.output_offset for m in models]),
        unsettled="; ".join(f"{m.name}: {m.unsettled}" for m in models if m.unsettled),
    )
    return whole, {n: terms[n] for n in whole.inputs.names}


def free_entries(model: LinearModel) -> int:
    """Free entries of A, B, C, K up to a change of state coordinates, n (m + 2 p) per decoupled
    part, and those of D."""
    a, b, c, d, _ = model.matrices
    parts = _blocks(a, b, c)
    return sum(len(i) * (len(j) + 2 * len(o)) for i, j, o in parts) + int(np.count_nonzero(d))


def _blocks(
    a: FloatArray, b: FloatArray, c: FloatArray
) -> list[tuple[list[int], list[int], list[int]]]:
    """(states, inputs, outputs) of the parts of a model that do not touch each other."""
    n = len(a)
    left, out = set(range(n)), []
    while left:
        members, new = set(), {min(left)}
        while new:
            members |= new
            i = sorted(members)
            inputs, outputs = np.any(b[i] != 0, axis=0), np.any(c[:, i] != 0, axis=1)
            linked = np.any(a[i] != 0, axis=0) | np.any(a[:, i] != 0, axis=1)
            linked |= np.any(b[:, inputs] != 0, axis=1) | np.any(c[outputs] != 0, axis=0)
            new = set(np.flatnonzero(linked).tolist()) - members
        i = sorted(members)
        out.append(
            (
                i,
                np.flatnonzero(np.any(b[i] != 0, axis=0)).tolist(),
                np.flatnonzero(np.any(c[:, i] != 0, axis=1)).tolist(),
            )
        )
        left -= members
    return out
