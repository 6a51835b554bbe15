"""Times of the tube MPC and of its peers are of one clock: CPU time around the call."""

import time
from types import SimpleNamespace

import numpy as np

from benchmarks.tube_peers import ours


class Waits:
    """A solver that waits for 20 ms and says so."""

    def __init__(self):
        one, plane = np.zeros(()), np.zeros((3, 2, 4))
        self.data = {"tube_updates_max": one, "qp_iterations_max": one, "x0": np.zeros(3)}
        self.data |= {"plane": plane, "u": np.zeros((2, 4))}

    def reset(self):
        """Nothing."""

    def solve(self):
        """What the clock on the wall says."""
        time.sleep(0.02)
        return SimpleNamespace(seconds=0.02, status=0)


def test_waiting_is_no_time_of_ours():
    assert ours(Waits(), np.zeros(3))[1] < 0.005
