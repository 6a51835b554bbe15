"""LinearModel: a discrete linear state-space model in innovation form, with names and units. One of
the `Dynamics`.

x[k+1] = A x[k] + B (u[k-delay] - u0) + K e[k],  y[k] = y0 + C x[k] + D (u[k-delay] - u0) + e[k],  cov(e) = Lambda.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import scipy.linalg as sla

from greybox.errors import FileFormatError, ModelError
from greybox.files import MALFORMED, Json, Parsed, checksum, read_json, to_plain, write_json
from greybox.model.matrices import Matrices, spectral_radius
from greybox.model.parameter import Parameter
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, Signal, sum_of

if TYPE_CHECKING:
    import control

SCHEMA = "greybox.linear_model/1"
LONGEST_DELAY = 10_000
"""Samples; a step of the model sees so many commands."""


@dataclass(frozen=True, kw_only=True, repr=False)
class LinearModel(Shown):
    """A (n, n), B (n, m), C (p, n), D (p, m), K (n, p), Lambda (p, p), sample time `dt` [s], names
    and operating point.

    `delays` are whole samples per input; `input_offset` (m,) and `output_offset` (p,) are the
    operating point in the units of the channels. `unsettled` says how a fit ended that did not
    converge ("" where it did). Raises `ModelError` where the sizes do not fit or
    Lambda is not a covariance.
    """

    name: str
    matrices: Matrices
    noise: FloatArray
    dt: float
    inputs: Layout
    outputs: Layout
    delays: tuple[int, ...] = ()
    input_offset: FloatArray = field(default_factory=lambda: np.zeros(0))
    output_offset: FloatArray = field(default_factory=lambda: np.zeros(0))
    comment: str = ""
    unsettled: str = ""

    def __post_init__(self) -> None:
        m, p = len(self.inputs), len(self.outputs)
        arrays = [np.array(v, dtype=np.float64, copy=True) for v in self.matrices]
        n = arrays[0].shape[0] if arrays[0].ndim == 2 else -1
        for what, array, shape in zip("ABCDK", arrays, ((n, n), (n, m), (p, n), (p, m), (n, p))):
            if array.shape != shape:
                raise ModelError(
                    f"{self.name}: {what} has shape {array.shape}", expected=f"{shape}"
                )
            if not np.isfinite(array).all():
                raise ModelError(f"{self.name}: {what} is not finite")
        noise = np.array(self.noise, dtype=np.float64, copy=True).reshape(p, p)
        if (
            not np.allclose(noise, noise.T, rtol=1e-8, atol=0)
            or np.linalg.eigvalsh(noise).min(initial=0.0) < 0
        ):
            raise ModelError(f"{self.name}: Lambda is not symmetric positive semi-definite")
        if not 0 < self.dt < np.inf:
            raise ModelError(f"{self.name}: sample time must be positive", got=f"{self.dt:g} s")
        object.__setattr__(self, "matrices", Matrices(*arrays))
        object.__setattr__(self, "noise", noise)
        for what, size in (("input_offset", m), ("output_offset", p)):
            value = np.asarray(getattr(self, what), dtype=np.float64)
            value = np.zeros(size) if value.size == 0 else value
            if value.shape != (size,):
                raise ModelError(
                    f"{self.name}: {what} has shape {value.shape}", expected=f"({size},)"
                )
            object.__setattr__(self, what, value)
            if not np.isfinite(value).all():
                raise ModelError(f"{self.name}: {what} is not finite")
        delays = tuple(int(d) for d in self.delays) or (0,) * m
        if (
            len(delays) != m
            or not 0 <= min(delays, default=0) <= max(delays, default=0) <= LONGEST_DELAY
        ):
            raise ModelError(
                f"{self.name}: delays {delays}",
                expected=f"{m} whole numbers from 0 to {LONGEST_DELAY}",
            )
        object.__setattr__(self, "delays", delays)

    def _shown_text(self) -> str:
        """Size, channels and how fast it forgets."""
        lines = [
            f"{self.name}: linear model of order {self.order}, sample time {self.dt:g} s",
            f"  inputs {', '.join(self.inputs.names) or 'none'}; delays "
            f"{', '.join(map(str, self.delays)) or 'none'}",
            f"  outputs {', '.join(self.outputs.names)}",
            f"  spectral radius {spectral_radius(self.matrices.a):.4f}",
        ]
        if self.unsettled:
            lines.append(f"  {self.unsettled}")
        return "\n".join(lines)

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per mode (of a pair the upper pole): pole, natural frequency and damping
        ratio."""
        rows: list[dict[str, Cell]] = []
        for pole in np.linalg.eigvals(self.matrices.a):
            if pole.imag >= 0:
                s = np.log(complex(pole)) / self.dt if pole != 0 else complex(-np.inf)
                size = abs(s)
                damping = None if size == 0 else float(-s.real / size) if np.isfinite(size) else 1.0
                rows.append(
                    {
                        "real": float(pole.real),
                        "imag": float(pole.imag),
                        "frequency [rad/s]": float(size),
                        "damping": damping,
                    }
                )
        return rows

    @property
    def dynamics(self) -> LinearModel:
        """Itself: the equations, as of an identified model."""
        return self

    @property
    def sample_time(self) -> float:
        """`dt` [s], as of an identified model."""
        return self.dt

    @property
    def values(self) -> dict[str, float]:
        """The entries of A, B, C, D, K by name, as of an identified model."""
        return {q.name: q.nominal for q in self.parameters}

    @property
    def domain(self) -> Mapping[str, tuple[float, float]]:
        """Nothing: the ranges of the training are not kept."""
        return {}

    @property
    def trained_on(self) -> tuple[str, ...]:
        """Nothing: the flights of the training are not kept."""
        return ()

    @property
    def order(self) -> int:
        """Number of states n."""
        return self.matrices.order

    @property
    def states(self) -> Layout:
        """x1 .. xn; they have no physical meaning unless the model was built from physics."""
        return Layout([Signal(name=f"x{i + 1}", unit="1") for i in range(self.order)])

    @property
    def error_states(self) -> Layout:
        """The states themselves."""
        return self.states

    @property
    def innovations(self) -> Layout:
        """One per output."""
        return self.outputs

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Each innovation needs the output of its own name."""
        return tuple((n,) for n in self.outputs.names)

    @property
    def noises(self) -> Layout:
        """The innovations e: they enter the state through K and the output directly, with
        covariance `noise`."""
        return self.outputs

    @property
    def window(self) -> tuple[int, int]:
        """As many earlier commands as the longest delay."""
        return (max(self.delays, default=0), 0)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All entries of A, B, C, D, K as A.1.1, A.1.2, ...; nominal = the value here. Redundant if
        all are freed."""
        return tuple(
            Parameter(
                name=f"{what}.{i + 1}.{j + 1}",
                unit="1",
                nominal=float(v),
                scale=max(abs(float(v)), 1e-3),
                meaning=f"entry of {what}",
            )
            for what, matrix in zip("ABCDK", self.matrices)
            for (i, j), v in np.ndenumerate(matrix)
        )

    def _unpacked(self, p: Expr) -> list[Expr]:
        out, first = [], 0
        for matrix in self.matrices:
            rows, columns = matrix.shape
            count = rows * columns
            part = p[first : first + count]
            out.append(ca.reshape(part, columns, rows).T if count else ca.DM.zeros(rows, columns))
            first += count
        return out

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """The next state (the model is discrete) at the command u (m,) and innovation w, without
        delay."""
        a, b, _, _, k = self._unpacked(p)
        after = a @ x + b @ (u - self.input_offset)
        return after if w is None else after + k @ w

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Outputs (p,) at the command u and innovation w."""
        _, _, c, d, _ = self._unpacked(p)
        y = c @ x + d @ (u - self.input_offset) + self.output_offset
        return y if w is None else y + w

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Next state with innovation w; `dt` is the sample time of the model and is not used."""
        return self.f(t, x, self._delayed(window), p, w)

    def output(
        self,
        t: Expr,
        x: Expr,
        window: Expr,
        p: Expr,
        w: Expr,
        dt: Expr,
        lasting: Expr = None,
    ) -> Expr:
        """Outputs with innovation w."""
        return self.h(t, x, self._delayed(window), p, sum_of(w, lasting))

    def _delayed(self, window: Expr) -> Expr:
        past = self.window[0]
        return ca.vertcat(*[window[i, past - d] for i, d in enumerate(self.delays)])

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """y - y_hat."""
        return y - y_hat

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """x + d."""
        return x + d

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """x2 - x1."""
        return x2 - x1

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Zero, with the spread of the stationary state under unit white inputs (1 where A is not
        stable)."""
        a, b, _, _, k = self.matrices
        if spectral_radius(a) >= 1.0 or self.order == 0:
            return np.zeros(self.order), np.ones(self.order)
        stationary = sla.solve_discrete_lyapunov(a, b @ b.T + k @ self.noise @ k.T)
        return np.zeros(self.order), np.sqrt(np.maximum(np.diag(stationary), 1e-12))

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Zero: the matrices are the same at every state."""
        return np.zeros(self.order)

    def noise_scale(self, dt: float) -> FloatArray:
        """Standard deviations of the innovations, which are the process noise of this form."""
        return np.sqrt(np.maximum(np.diag(self.noise), 1e-300))

    def sensor_scale(self) -> FloatArray:
        """A thousandth of the innovations: in innovation form e carries the sensor noise, and
        nothing is added to it."""
        return 1e-3 * self.noise_scale(self.dt)

    def to_control(self, *, include_delays: bool = False) -> control.StateSpace:
        """`control.StateSpace` from u to y (deviations from the operating point), with dt and
        names, in which control allows no dot (position_x).

        With `include_delays` every sample of delay becomes a state; without, a model with delays is
        refused with `ModelError`, because a silent loss of delay would give wrong margins.
        """
        import control

        a, b, c, d, _ = self.matrices
        if any(self.delays):
            if not include_delays:
                raise ModelError(
                    f"{self.name}: input delays {self.delays} are not part of A, B, C, D",
                    fix="to_control(include_delays=True)",
                )
            a, b, c, d = _with_delays(a, b, c, d, self.delays)
        return control.StateSpace(
            a,
            b,
            c,
            d,
            self.dt,
            inputs=[_plain(n) for n in self.inputs.names],
            outputs=[_plain(n) for n in self.outputs.names],
            name=_plain(self.name),
        )

    @staticmethod
    def from_control(
        system: control.StateSpace,
        *,
        gain: FloatArray | None = None,
        noise: FloatArray | None = None,
        dt: float | None = None,
    ) -> LinearModel:
        """From `control.StateSpace`; K defaults to 0 and Lambda to the identity.

        A continuous system needs `dt` [s] and is sampled with the input held. Raises `ModelError`
        without one.
        """
        import control

        if system.dt == 0:
            if dt is None:
                raise ModelError(
                    "a continuous system needs a sample time", fix="from_control(system, dt=0.01)"
                )
            system = control.c2d(system, dt, method="zoh")
        step = float(system.dt if dt is None and system.dt is not True else (dt or 1.0))
        a, b, c, d = (
            np.atleast_2d(np.asarray(v, dtype=float))
            for v in (system.A, system.B, system.C, system.D)
        )
        n, p = a.shape[0], c.shape[0]
        return LinearModel(
            name=str(system.name or "linear"),
            matrices=Matrices(a, b, c, d, np.zeros((n, p)) if gain is None else np.asarray(gain)),
            noise=np.eye(p) if noise is None else noise,
            dt=step,
            inputs=Layout([Signal(name=n, unit="1") for n in system.input_labels]),
            outputs=Layout([Signal(name=n, unit="1") for n in system.output_labels]),
        )

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON value with schema and checksum."""
        body: dict[str, object] = {
            "schema": SCHEMA,
            "name": self.name,
            "comment": self.comment,
            **({"unsettled": self.unsettled} if self.unsettled else {}),
            "dt": self.dt,
            "inputs": [_port(s) for s in self.inputs],
            "outputs": [_port(s) for s in self.outputs],
            "delays": list(self.delays),
            "input_offset": self.input_offset,
            "output_offset": self.output_offset,
            **dict(zip("ABCDK", self.matrices)),
            "Lambda": self.noise,
        }
        plain: dict[str, Json] = to_plain(body)
        return {**plain, "checksum": checksum(plain)}

    @staticmethod
    def from_dict(value: Parsed, *, where: str = "model") -> LinearModel:
        """The inverse of `to_dict`. Raises `FileFormatError` for missing fields or a wrong
        checksum."""
        body = {k: v for k, v in value.items() if k != "checksum"}
        if value.get("checksum") != checksum(body):
            raise FileFormatError(
                "checksum does not fit the content",
                where=where,
                fix="fit again; do not edit by hand",
            )
        try:
            ports = [*body["inputs"], *body["outputs"]]
            texts = [
                body["name"],
                body.get("comment", ""),
                body.get("unsettled", ""),
                *(s[k] for s in ports for k in ("name", "unit")),
                *(s.get("meaning", "") for s in ports),
            ]
            if not all(isinstance(v, str) for v in texts):
                raise ValueError("a name, unit, comment or status is not a text")
            m, p = len(body["inputs"]), len(body["outputs"])
            n = len(body["A"])
            shapes = ((n, n), (n, m), (p, n), (p, m), (n, p))
            matrices = Matrices(
                *[np.asarray(body[w], dtype=float).reshape(s) for w, s in zip("ABCDK", shapes)]
            )
            return LinearModel(
                name=body["name"],
                comment=body.get("comment", ""),
                unsettled=body.get("unsettled", ""),
                matrices=matrices,
                noise=np.asarray(body["Lambda"], dtype=float),
                dt=float(body["dt"]),
                inputs=Layout([_signal(s) for s in body["inputs"]]),
                outputs=Layout([_signal(s) for s in body["outputs"]]),
                delays=tuple(body["delays"]),
                input_offset=np.asarray(body["input_offset"], dtype=float),
                output_offset=np.asarray(body["output_offset"], dtype=float),
            )
        except MALFORMED as error:
            raise FileFormatError(f"not a linear model ({error})", where=where) from None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write JSON (schema greybox.linear_model/1), atomically."""
        return write_json(path, self.to_dict())

    @staticmethod
    def load(path: str | os.PathLike[str]) -> LinearModel:
        """Read what `save` wrote. Raises `FileFormatError`."""
        return LinearModel.from_dict(read_json(path, schema=SCHEMA), where=str(path))


def _port(signal: Signal) -> dict[str, str]:
    """An input or output of the file."""
    own = {"name": signal.name, "unit": signal.unit}
    return {**own, "meaning": signal.meaning} if signal.meaning else own


def _signal(port: Mapping[str, str]) -> Signal:
    return Signal(name=port["name"], unit=port["unit"], meaning=port.get("meaning", ""))


def _with_delays(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, delays: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shift registers in front of every delayed input."""
    n, m = b.shape
    total = n + sum(delays)
    big_a, big_b = np.zeros((total, total)), np.zeros((total, m))
    big_c, big_d = np.zeros((len(c), total)), np.zeros_like(d)
    big_a[:n, :n], big_c[:, :n] = a, c
    position = n
    for i, length in enumerate(delays):
        if length == 0:
            big_b[:n, i], big_d[:, i] = b[:, i], d[:, i]
            continue
        last = position + length - 1
        big_b[position, i] = 1.0
        for j in range(position, last):
            big_a[j + 1, j] = 1.0
        big_a[:n, last], big_c[:, last] = b[:, i], d[:, i]
        position += length
    return big_a, big_b, big_c, big_d


def _plain(name: str) -> str:
    return "".join(ch if ch.isalnum() or ch == "_" else "_" for ch in name) or "linear"
