"""How good and how fast is linear identification next to its Python peers, on the same records in
the same run?

    pip install nfoursid sippy_unipi llsi jax-sysid     (in an environment of their own, with greybox on PYTHONPATH)
    python benchmarks/linear_peers.py --out linear_peers.json

Truths: three random systems of order 6 with 4 inputs and 3 outputs, and three of order 4 with one
input and one output (so that llsi, whose n4sid refuses several inputs, takes part); coloured
disturbance, 20 dB; 3000 samples to train, 3000 to test, open and closed loop, orders 2-8. Each
method gives A, B, C, D and, where it has one, K (nfoursid: the Riccati gain of its noise
covariances; jax-sysid and llsi have no noise model, K = 0). Score: log det of the one-step
innovation covariance on the test record, initial state by least squares for all alike. The feedback
acts on the same sample, so that a free D lets u[k] tell of e[k]: a method that returns D (nfoursid,
llsi) is compared to greybox with D free, the others to greybox with D = 0. The standard error of
the difference is a block bootstrap (blocks of 50 samples, 300 draws). Time: processor seconds of
identification only, best of three, one thread; "greybox fit_linear" is the same with robust
covariance, whiteness and warnings, which no peer has.
"""

# ruff: noqa: E402

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import contextlib
import io
import json
import time
import warnings
from collections.abc import Callable

import numpy as np

from greybox.linear.fit import Options, fit_linear
from greybox.linear.pem import Settings, start_nuisances
from greybox.linear.predictor import predict
from greybox.linear.records import Record, prepare
from greybox.linear.search import find
from greybox.linear.subspace import subspace
from greybox.model.matrices import Matrices, spectral_radius, steady_gain
from scenarios.plants.linear_systems import random_system, simulate, stabilising_feedback

Identify = Callable[[np.ndarray, np.ndarray, int], Matrices]


def ours(u, y, n):
    scaled, scale = prepare([Record(u=u, y=y)])
    return find(scaled, n, Options()).solution.system.scaled(
        1 / scale.input_scale, 1 / scale.output_scale
    )


def ours_direct(u, y, n):
    scaled, scale = prepare([Record(u=u, y=y)])
    options = Options(feedthrough=True)
    return find(scaled, n, options).solution.system.scaled(
        1 / scale.input_scale, 1 / scale.output_scale
    )


def ours_complete(u, y, n):
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
        np.hstack([u, y]),
        columns=[*(f"u{i}" for i in range(u.shape[1])), *(f"y{i}" for i in range(y.shape[1]))],
    )
    names = list(frame.columns)
    method = NFourSID(
        frame,
        output_columns=names[u.shape[1] :],
        input_columns=names[: u.shape[1]],
        num_block_rows=10,
    )
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
        return Matrices(
            *(np.asarray(v, dtype=float) for v in (found.A, found.B, found.C, found.D, found.K))
        )

    return identify


def llsi(u, y, n):
    from llsi import iddata
    from llsi import n4sid as method

    found = method(iddata(y, u, 1.0), n)
    return Matrices(
        *(np.asarray(v, dtype=float) for v in (found.A, found.B, found.C, found.D)),
        np.zeros((n, y.shape[1])),
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
    "greybox with D": ours_direct,
    "greybox fit_linear": ours_complete,
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


def difference_error(e: np.ndarray, base: np.ndarray) -> float:
    """Block-bootstrap standard error of log det(e) - log det(base); its draws are its own, so that
    no record depends on which methods take part."""
    rng = np.random.default_rng(0)
    blocks = len(e) // 50
    parts = np.arange(blocks * 50).reshape(blocks, 50)
    draws = [parts[rng.integers(0, blocks, blocks)].ravel() for _ in range(300)]
    return float(np.std([log_det(e[i]) - log_det(base[i]) for i in draws], ddof=1))


SYSTEMS = {"MIMO": (6, 4, 3), "SISO": (4, 1, 1)}
"""Order, inputs, outputs."""
BASE = "greybox subspace + PEM"
STEP = "greybox subspace (pbsid)"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--orders", default="2,3,4,5,6,7,8")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--out", default=None)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    names = arguments.methods.split(",")
    rows = []
    for kind in arguments.systems.split(","):
        for seed in (int(v) for v in arguments.seeds.split(",")):
            rng = np.random.default_rng(seed)
            truth = random_system(rng, *SYSTEMS[kind])
            for loop in ("open", "closed"):
                feedback = stabilising_feedback(rng, truth) if loop == "closed" else None
                u, y = simulate(rng, truth, 6000, feedback=feedback)
                for n in (int(v) for v in arguments.orders.split(",")):
                    label = {"system": kind, "seed": seed, "loop": loop, "order": n}
                    rows += compare(label, names, (u[:3000], y[:3000]), (u[3000:], y[3000:]))
    summary = {
        kind: summarise([r for r in rows if r["system"] == kind], kind)
        for kind in arguments.systems.split(",")
    }
    worse = [r for r in rows if r.get("minus_greybox", 0.0) < -2 * r.get("std_error", np.inf)]
    peers = sum("minus_greybox" in r and not r["method"].startswith("greybox") for r in rows)
    print(
        f"cases in which a method is better than {BASE} beyond two standard errors: {len(worse)} "
        f"(peer fits: {peers})"
    )
    for r in worse:
        print("  ", r)
    if arguments.out:
        with open(arguments.out, "w", encoding="utf-8") as stream:
            json.dump(
                {
                    "summary": summary,
                    "better_than_greybox": worse,
                    "peer_fits": peers,
                    "rows": rows,
                },
                stream,
                indent=1,
            )
    return 0


def compare(label, names, train, test) -> list[dict]:
    """One row per method: seconds, log det on the test record, its difference to greybox with
    standard error."""
    rows, base = [], {}
    for name in names:
        seconds, system, problem = [], None, ""
        for _ in range(1 if name == "jax-sysid" else 3):
            started = time.process_time()
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    system = METHODS[name](*train, label["order"])
            except Exception as error:
                problem = f"{type(error).__name__}: {error}"
            seconds.append(time.process_time() - started)
        row = {**label, "method": name, "seconds": min(seconds)}
        if system is None:
            row["problem"] = problem[:120]
        else:
            e = innovations(system, *test)
            direct = bool(np.any(system.d))
            own = base.setdefault(direct, e)
            row["log_det"] = log_det(e) if np.isfinite(e).all() else float("inf")
            row["minus_greybox"] = row["log_det"] - log_det(own)
            row["std_error"] = difference_error(e, own) if np.isfinite(e).all() else float("nan")
        rows.append(row)
        print(
            f"{label['system']} {label['seed']} {label['loop']:6} n={label['order']} {name:26} "
            f"{row['seconds']:8.4f} s  log det {row.get('log_det', np.nan):9.4f}  minus greybox "
            f"{row.get('minus_greybox', np.nan):+9.4f} +- {row.get('std_error', np.nan):.4f} "
            f"{row.get('problem', '')}",
            flush=True,
        )
    return rows


def summarise(rows: list[dict], kind: str) -> dict:
    """Per method: median seconds, and how many times slower it is than greybox: per case, then
    median and range."""
    case = {
        (r["method"], r["seed"], r["loop"], r["order"]): r["seconds"]
        for r in rows
        if "problem" not in r
    }
    orders = sorted({r["order"] for r in rows})
    out: dict = {}
    print(
        f"\n{kind}: median seconds; ratio to {STEP} (median); ratio to {BASE}: median, worst case, "
        "median per order"
    )
    for name in dict.fromkeys(r["method"] for r in rows):
        keys = [k[1:] for k in case if k[0] == name]
        if not keys:
            continue
        whole = {k: case[name, *k] / case[BASE, *k] for k in keys if (BASE, *k) in case}
        step = [case[name, *k] / case[STEP, *k] for k in keys if (STEP, *k) in case]
        by_order = {n: float(np.median([v for k, v in whole.items() if k[2] == n])) for n in orders}
        out[name] = {
            "median_seconds": float(np.median([case[name, *k] for k in keys])),
            "ratio_to_subspace": float(np.median(step)) if step else None,
            "ratio": float(np.median(list(whole.values()))),
            "worst_ratio": min(whole.values()),
            "ratio_by_order": by_order,
        }
        o = out[name]
        print(
            f"{name:26} {o['median_seconds']:8.4f} s  x{o['ratio_to_subspace'] or np.nan:7.1f}  "
            f"x{o['ratio']:6.1f} "
            f"x{o['worst_ratio']:6.2f}  " + " ".join(f"{n}:{v:.1f}" for n, v in by_order.items())
        )
    return out


if __name__ == "__main__":
    raise SystemExit(main())
