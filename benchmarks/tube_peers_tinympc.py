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
    matrices = [given["A"], given["B"], np.diag(given["Q"]), np.diag(given["R"])]
    tolerance = float(given["tolerance"])
    chosen = {"rho": float(given["rho"]), "abs_pri_tol": tolerance, "abs_dua_tol": tolerance}
    limits = {k: given[k] for k in ("x_min", "x_max", "u_min", "u_max")}
    commands, iterations, seconds = [], [], []
    for x in given["starts"]:
        spent = []
        for _ in range(REPEATS):
            # anew: a solver that has solved begins where it ended
            solver = tinympc.TinyMPC()
            solver.setup(
                *matrices, n, max_iter=int(given["most"]), check_termination=1, **chosen, **limits
            )
            solver.set_x0(x)
            begin = time.process_time()
            found = solver.solve()
            spent.append(time.process_time() - begin)
        commands.append(np.asarray(found["controls_all"]).tolist())
        iterations.append(int(solver._solver.solution.iter))
        seconds.append(float(np.median(spent)))
    json.dump({"commands": commands, "iterations": iterations, "seconds": seconds}, sys.stdout)


if __name__ == "__main__":
    main()
