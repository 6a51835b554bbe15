"""How good and how fast is linear identification next to its Python peers, on the same records in the same run?

    pip install nfoursid sippy_unipi llsi jax-sysid     (in an environment of their own, with greybox on PYTHONPATH)
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/linear_peers.py --out linear_peers.json

Truth: order 6, 4 inputs, 3 outputs, coloured disturbance, 20 dB; 3000 samples to train, 3000 to test, open and closed
loop. Each method gives A, B, C, D and, where it has one, K (nfoursid: the Riccati gain of its noise covariances;
jax-sysid has no noise model, K = 0; llsi's n4sid refuses several inputs, which the table says). Score: log det of the
one-step innovation covariance on the test record, initial state by least squares for all alike. The standard error of
the difference to greybox is a block bootstrap (blocks of 50 samples, 300 draws). Time: identification only, best of two.
"""

# ruff: noqa: E402

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import argparse
import contextlib
import io
import json
import time
import warnings
from collections.abc import Callable

import numpy as np

from greybox.estimation.linear.fit import fit_linear
from greybox.estimation.linear.pem import Settings, start_nuisances
from greybox.estimation.linear.predictor import predict
from greybox.estimation.linear.records import Record, prepare
from greybox.estimation.linear.subspace import subspace
from greybox.model.matrices import Matrices, spectral_radius, steady_gain
from scenarios.plants.linear_systems import random_system, simulate, stabilising_feedback

Identify = Callable[[np.ndarray, np.ndarray, int], Matrices]


def ours(u, y, n):
    return fit_linear([Record(u=u, y=y)], n).model.matrices


def ours_subspace(method):
    def identify(u, y, n):
        scaled, scale = prepare([Record(u=u, y=y)])
        found = subspace(scaled, method, order=n, feedthrough=False).realise(n)
        return found.scaled(1 / scale.input_scale, 1 / scale.output_scale)

    return identify


def nfoursid(u, y, n):
    import pandas
    from nfoursid.nfoursid import NFourSID

    frame = pandas.DataFrame(
        np.hstack([u, y]), columns=[*(f"u{i}" for i in range(u.shape[1])), *(f"y{i}" for i in range(y.shape[1]))]
    )
    names = list(frame.columns)
    method = NFourSID(frame, output_columns=names[u.shape[1] :], input_columns=names[: u.shape[1]], num_block_rows=10)
    method.subspace_identification()
    system, covariance = method.system_identification(rank=n)
    p = y.shape[1]
    r, s, q = covariance[:p, :p], covariance[p:, :p], covariance[p:, p:]
    gain, _, _ = steady_gain(system.a, system.c, q + 1e-12 * np.eye(n), r, s)
    return Matrices(system.a, system.b, system.c, system.d, gain)


def sippy(method):
    def identify(u, y, n):
        from sippy_unipi import system_identification

        found = system_identification(y.T, u.T, method, SS_fixed_order=n)
        return Matrices(*(np.asarray(v, dtype=float) for v in (found.A, found.B, found.C, found.D, found.K)))

    return identify


def llsi(u, y, n):
    from llsi import iddata
    from llsi import n4sid as method

    found = method(iddata(y, u, 1.0), n)
    return Matrices(
        *(np.asarray(v, dtype=float) for v in (found.A, found.B, found.C, found.D)), np.zeros((n, y.shape[1]))
    )


def jax_sysid(u, y, n):
    from jax_sysid.models import LinearModel

    scale_u, scale_y = u.std(axis=0), y.std(axis=0)
    model = LinearModel(n, y.shape[1], u.shape[1], feedthrough=False)
    model.loss(rho_x0=1e-3, rho_th=1e-4)
    model.optimization(adam_epochs=500, lbfgs_epochs=1000)
    model.fit(y / scale_y, u / scale_u)
    a, b, c, d = model.ssdata()
    plain = Matrices(*(np.asarray(v, dtype=float) for v in (a, b, c, d)), np.zeros((n, y.shape[1])))
    return plain.scaled(1 / scale_u, 1 / scale_y)


METHODS: dict[str, Identify] = {
    "greybox subspace + PEM": ours,
    "greybox subspace (ssarx)": ours_subspace("ssarx"),
    "greybox subspace (pbsid)": ours_subspace("pbsid"),
    "nfoursid": nfoursid,
    "sippy N4SID": sippy("N4SID"),
    "sippy MOESP": sippy("MOESP"),
    "sippy CVA": sippy("CVA"),
    "sippy PARSIM-K": sippy("PARSIM-K"),
    "llsi n4sid": llsi,
    "jax-sysid": jax_sysid,
}


def innovations(system: Matrices, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """One-step innovations (N, p) on a record, initial state by least squares."""
    if spectral_radius(system.predictor) >= 1.0:
        return np.full_like(y, np.nan)
    record, settings = Record(u=u, y=y), Settings(offsets=False)
    start = start_nuisances(system, [record], settings)[0]
    return predict(system, record, start.x0, start.offset, np.eye(y.shape[1])).e


def log_det(e: np.ndarray) -> float:
    return float(np.linalg.slogdet(e.T @ e / len(e))[1])


def difference_error(e: np.ndarray, base: np.ndarray, rng: np.random.Generator) -> float:
    """Block-bootstrap standard error of log det(e) - log det(base)."""
    blocks = len(e) // 50
    parts = np.arange(blocks * 50).reshape(blocks, 50)
    draws = [parts[rng.integers(0, blocks, blocks)].ravel() for _ in range(300)]
    return float(np.std([log_det(e[i]) - log_det(base[i]) for i in draws], ddof=1))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--orders", default="2,3,4,5,6,7,8")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=None)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(arguments.seed)
    truth = random_system(rng, 6, 4, 3)
    rows = []
    for loop in ("open", "closed"):
        feedback = stabilising_feedback(rng, truth) if loop == "closed" else None
        u, y = simulate(rng, truth, 6000, feedback=feedback)
        train, test = (u[:3000], y[:3000]), (u[3000:], y[3000:])
        for n in (int(v) for v in arguments.orders.split(",")):
            base = None
            for name in arguments.methods.split(","):
                seconds, system, problem = [], None, ""
                for _ in range(1 if name == "jax-sysid" else 2):
                    started = time.perf_counter()
                    try:
                        with contextlib.redirect_stdout(io.StringIO()):
                            system = METHODS[name](*train, n)
                    except Exception as error:
                        problem = f"{type(error).__name__}: {error}"
                    seconds.append(time.perf_counter() - started)
                row = {"loop": loop, "order": n, "method": name, "seconds": min(seconds)}
                if system is None:
                    row["problem"] = problem[:120]
                else:
                    e = innovations(system, *test)
                    if base is None:
                        base = e
                    row["log_det"] = log_det(e) if np.isfinite(e).all() else float("inf")
                    row["minus_greybox"] = row["log_det"] - log_det(base)
                    row["std_error"] = difference_error(e, base, rng) if np.isfinite(e).all() else float("nan")
                rows.append(row)
                print(
                    f"{loop:6} n={n} {name:26} {row['seconds']:8.3f} s  log det {row.get('log_det', np.nan):9.4f}  "
                    f"minus greybox {row.get('minus_greybox', np.nan):+9.4f} +- {row.get('std_error', np.nan):.4f} "
                    f"{row.get('problem', '')}",
                    flush=True,
                )
    print("\nmedian seconds over orders and loops, and ratio to greybox subspace / subspace + PEM")
    median = {
        m: float(np.median([r["seconds"] for r in rows if r["method"] == m])) for m in arguments.methods.split(",")
    }
    for name, value in median.items():
        print(
            f"{name:26} {value:8.3f} s  x{value / median.get('greybox subspace (pbsid)', np.nan):7.1f}"
            f"  x{value / median.get('greybox subspace + PEM', np.nan):7.1f}"
        )
    worse = [r for r in rows if r.get("minus_greybox", 0.0) < -2 * r.get("std_error", np.inf)]
    print(f"cases in which a method is better than greybox subspace + PEM beyond two standard errors: {len(worse)}")
    for r in worse:
        print("  ", r)
    if arguments.out:
        with open(arguments.out, "w", encoding="utf-8") as stream:
            json.dump({"rows": rows, "median_seconds": median}, stream, indent=1)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
