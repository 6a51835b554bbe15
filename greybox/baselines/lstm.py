"""LSTMModel: a two-layer long short-term memory network over a window of past samples, as plain
numbers.

The baseline of Ghoul et al. 2026 (network: Hochreiter and Schmidhuber, Neural Computation 9(8),
1997, with the forget gate of Gers et al., Neural Computation 12(10), 2000). The window runs from
the oldest to the newest sample; step i sees the outputs i samples before the predicted one and the
inputs of that row; what lies beyond n_a or n_b is zero in standardised units. The last state of the
upper layer goes through one linear layer. Nothing is remembered between predictions.

The equations stand once, in `_network`, for NumPy rows and for CasADi. Training is in
lstm_train.py, which alone needs PyTorch.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.baselines.regressors import Lags, NetworkReport
from greybox.data import Segment
from greybox.errors import FileFormatError, ModelError
from greybox.files import checksum, read_json, to_plain, well_formed, write_atomic, write_json
from greybox.residual.array_file import load_arrays, packed
from greybox.symbolic import FloatArray, Namespace, Numeric

SCHEMA = "greybox.lstm/1"
BATCH = 8192
"""Windows that go through the network at once (bounds the memory)."""
_VECTORS = ("input_mean", "input_scale", "target_mean", "target_scale", "variance")


class WindowedNetwork:
    """What a network that tells the next sample from `lags` predicts: one step, and on with its own
    predictions.

    `variance` (h_max, n_y): mean squared error of the free run at horizon 1 .. h_max on validation
    data; later horizons get the last.
    """

    lags: Lags
    variance: FloatArray

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the predicted channels."""
        return self.lags.outputs

    def mean(self, z: FloatArray) -> FloatArray:
        """Predicted outputs (N, n_y) for rows of regressors (N, n_z); NaN where a regressor is
        missing."""
        raise NotImplementedError

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_y), teacher-forced: every window holds measured samples."""
        mean = self.mean(self.lags.rows(segment))
        return mean, np.where(np.isfinite(mean), self.variance[0], np.nan)

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_y): predictions take the place of the outputs not yet
        measured."""
        past, moved = self.lags.starts(segment, origins, horizon)
        mean = np.empty((len(past), horizon, len(self.outputs)))
        for h in range(horizon):
            mean[:, h] = self.mean(Lags.joined(past, moved[:, h]))
            past = self.lags.pushed(past, mean[:, h])
        spread = self.variance[np.minimum(np.arange(horizon), len(self.variance) - 1)]
        return mean, np.where(np.isfinite(mean), spread, np.nan)


@dataclass(frozen=True, kw_only=True, eq=False)
class LSTMModel(WindowedNetwork):
    """A trained network: predicts `lags.outputs` from `lags`. Plain float64 numbers, no torch.

    `input_mean`, `input_scale` (n_z,) and `target_mean`, `target_scale` (n_y,) standardise; with
    `increments` the target is y[t] - y[t-1]. `layers`: per layer input weights (4 H, d), recurrent
    weights (4 H, H) and bias (4 H,), gates in the order input, forget, cell, output; `head`:
    weights (n_y, H) and bias (n_y,). `report` says how it was trained, `dt` [s] is the sample time
    of the training data. Raises `ModelError` where shapes do not fit.
    """

    lags: Lags
    increments: bool
    input_mean: FloatArray
    input_scale: FloatArray
    target_mean: FloatArray
    target_scale: FloatArray
    layers: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]
    head: tuple[FloatArray, FloatArray]
    variance: FloatArray
    train_seconds: float = 0.0
    report: NetworkReport = field(default_factory=NetworkReport)
    dt: float | None = None

    def __post_init__(self) -> None:
        n_z, n_y = self.lags.width, len(self.lags.outputs)
        width = n_y + len(self.lags.inputs)
        want: list[tuple[FloatArray, tuple[int, ...]]] = [
            (self.input_mean, (n_z,)),
            (self.input_scale, (n_z,)),
            (self.target_mean, (n_y,)),
        ]
        want += [(self.target_scale, (n_y,)), (self.variance, (len(self.variance), n_y))]
        for w, r, b in self.layers:
            size = r.shape[1]
            want += [(w, (4 * size, width)), (r, (4 * size, size)), (b, (4 * size,))]
            width = size
        want += [(self.head[0], (n_y, width)), (self.head[1], (n_y,))]
        for value, shape in want:
            if value.shape != shape:
                raise ModelError(
                    "an array of the network does not fit",
                    expected=str(shape),
                    got=str(value.shape),
                )

    @property
    def parameters(self) -> int:
        """Number of weights."""
        return sum(a.size for layer in (*self.layers, self.head) for a in layer)

    def mean(self, z: FloatArray) -> FloatArray:
        """Predicted outputs (N, n_y) for rows of regressors (N, n_z); NaN where a regressor is
        missing."""
        out = np.full((len(z), len(self.outputs)), np.nan)
        whole = np.flatnonzero(np.isfinite(z).all(axis=1))
        for at in range(0, len(whole), BATCH):
            rows = whole[at : at + BATCH]
            out[rows] = self._network(z[rows], np)
        return out

    def function(self, name: str = "lstm") -> ca.Function:
        """CasADi function z (n_z,) -> mean (n_y,): the same network, for export."""
        z = ca.MX.sym("z", self.lags.width)
        return ca.Function(name, [z], [self._network(z.T, ca).T], ["z"], ["mean"])

    def _network(self, z: Numeric, xp: Namespace) -> Numeric:
        """Rows (N, n_z) -> (N, n_y), with xp NumPy or CasADi."""

        def times(a: Numeric, b: FloatArray) -> Numeric:
            return a @ b if xp is np else ca.mtimes(a, ca.DM(b))

        def row(b: FloatArray) -> Numeric:
            return b if xp is np else ca.DM(b).T

        x = (z - row(self.input_mean)) / row(self.input_scale)
        n_y, n_u, n_a, n_b = (
            len(self.lags.outputs),
            len(self.lags.inputs),
            self.lags.n_a,
            self.lags.n_b,
        )
        steps = []
        for lag in range(max(n_a, n_b), 0, -1):
            # The input weights of what the window does not hold are left out: those inputs are
            # zero.
            past = x[:, (lag - 1) * n_y : lag * n_y] if lag <= n_a else None
            first = n_a * n_y + (lag - 1) * n_u
            moved = x[:, first : first + n_u] if lag <= n_b and n_u else None
            steps.append((past, moved))
        hidden: list[Numeric] = []
        for number, (w, r, b) in enumerate(self.layers):
            size, state, memory, states = r.shape[1], None, None, []
            for step in range(len(steps)):
                if number == 0:
                    past, moved = steps[step]
                    parts = [] if past is None else [times(past, w[:, :n_y].T)]
                    parts += [] if moved is None else [times(moved, w[:, n_y:].T)]
                else:
                    parts = [times(hidden[step], w.T)]
                gates = sum(parts[1:], parts[0]) + row(b)
                if state is not None:
                    gates = gates + times(state, r.T)
                enter, forget, leave = (
                    _sigmoid(gates[:, k * size : (k + 1) * size], xp) for k in (0, 1, 3)
                )
                fresh = enter * xp.tanh(gates[:, 2 * size : 3 * size])
                memory = fresh if memory is None else forget * memory + fresh
                state = leave * xp.tanh(memory)
                states.append(state)
            hidden = states
        y = times(hidden[-1], self.head[0].T) + row(self.head[1])
        y = y * row(self.target_scale) + row(self.target_mean)
        return y + z[:, :n_y] if self.increments else y

    # --------------------------------------------------------------------------------------- files

    def _arrays(self) -> dict[str, FloatArray]:
        named = {n: getattr(self, n) for n in _VECTORS}
        for i, layer in enumerate(self.layers):
            named |= {
                f"layer{i}.{part}": a for part, a in zip(("input", "recurrent", "bias"), layer)
            }
        return named | {"head.weight": self.head[0], "head.bias": self.head[1]}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write `path` (JSON) and the arrays beside it (.npz), each atomically."""
        arrays = self._arrays()
        target = Path(path)
        write_atomic(target.with_suffix(".npz"), packed(arrays))
        body = to_plain(
            {
                "schema": SCHEMA,
                "lags": {f: getattr(self.lags, f) for f in Lags.__dataclass_fields__},
                "increments": self.increments,
                "dt": self.dt,
                "layers": len(self.layers),
                "train_seconds": self.train_seconds,
                "report": {**self.report},
                "arrays": {n: {"shape": a.shape, "sha256": checksum(a)} for n, a in arrays.items()},
            }
        )
        return write_json(target, {**body, "checksum": checksum(body)})

    @staticmethod
    def load(path: str | os.PathLike[str]) -> LSTMModel:
        """Read what `save` wrote. Raises `FileFormatError`."""
        where = str(path)
        body = read_json(path, schema=SCHEMA)
        if body.pop("checksum", None) != checksum(body):
            raise FileFormatError(
                "the checksum does not fit", where=where, fix="train again; do not edit by hand"
            )
        with well_formed(where, fix="train again"):
            arrays = load_arrays(Path(path).with_suffix(".npz"))
            for name, stated in body["arrays"].items():
                if checksum(arrays[name]) != stated["sha256"]:
                    raise FileFormatError(
                        f"array '{name}' does not fit its checksum", where=where, fix="train again"
                    )
            return LSTMModel(
                lags=Lags(**body["lags"]),
                increments=bool(body["increments"]),
                layers=tuple(
                    (
                        arrays[f"layer{i}.input"],
                        arrays[f"layer{i}.recurrent"],
                        arrays[f"layer{i}.bias"],
                    )
                    for i in range(int(body["layers"]))
                ),
                head=(arrays["head.weight"], arrays["head.bias"]),
                train_seconds=float(body["train_seconds"]),
                report=body["report"],
                dt=body.get("dt"),
                **{n: arrays[n] for n in _VECTORS},
            )


def _sigmoid(x: Numeric, xp: Namespace) -> Numeric:
    return 0.5 + 0.5 * xp.tanh(0.5 * x)
