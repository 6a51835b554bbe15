"""TinyMPC's part of tube_peers, run by the Python that has it (numpy and tinympc alone): reads one
JSON object from standard input, writes one to standard output.

In: A, B, Q, R (diagonals), N, u_min, u_max, x_min, x_max, starts (n, n_x), rho, tolerance.
Out: commands (n, N, n_u), iterations (n,), seconds (n,) of the CPU.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import tinympc

REPEATS = 5


def main() -> None:
    given = {k: np.array(v, dtype=float) for k, v in json.load(sys.stdin).items()}
    n = int(given["N"]) + 1
    solver = tinympc.TinyMPC()
    matrices = [given["A"], given["B"], np.diag(given["Q"]), np.diag(given["R"])]
    limits = {k: given[k] for k in ("x_min", "x_max", "u_min", "u_max")}
    tolerance = float(given["tolerance"])
    solver.setup(
        *matrices,
        n,
        rho=float(given["rho"]),
        max_iter=2000,
        abs_pri_tol=tolerance,
        abs_dua_tol=tolerance,
        check_termination=1,
        **limits,
    )
    commands, iterations, seconds = [], [], []
    for x in given["starts"]:
        spent = []
        for _ in range(REPEATS):
            solver.reset() if hasattr(solver, "reset") else None
            solver.set_x0(x)
            begin = time.process_time()
            found = solver.solve()
            spent.append(time.process_time() - begin)
        commands.append(np.asarray(found["controls_all"]).T.tolist())
        iterations.append(int(found.get("iterations", -1)))
        seconds.append(float(np.median(spent)))
    json.dump({"commands": commands, "iterations": iterations, "seconds": seconds}, sys.stdout)


if __name__ == "__main__":
    main()
