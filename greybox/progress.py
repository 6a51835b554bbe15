"""How long work will still take, in the words of a person; in a notebook as a line that moves."""

from __future__ import annotations

import functools
import html
import math
import sys
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

FIRST = 2.0
"""Seconds of work before which nothing is said: shorter stages end by themselves."""
ARRIVED = 1e-6
"""Expected decrease of the cost at which a solver stops (as `LevenbergMarquardt.tolerance`)."""
LAST = 4
"""Iterations from which the rate of convergence is read."""


def about(seconds: float) -> str:
    """About how long, rounded as a person would."""
    if seconds < 90:
        return f"about {max(10, round(seconds, -1)):.0f} s"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} min"
    return f"about {seconds / 3600:.1f} h"


def in_words(seconds: float) -> str:
    """About how long is left."""
    return f"{about(seconds)} left"


class TimeLeft:
    """Says how long is left from the share that is done. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began = clock()
        self._steps: list[tuple[float, float]] = []

    def after(self, share: float) -> str:
        """ ", about ... left" when `share` (0 to 1) is done at the pace so far, "" where it is too
        early to tell."""
        spent = self._clock() - self._began
        if spent < FIRST or not 0.02 <= share < 1.0:
            return ""
        return f", {in_words(spent / share * (1 - share))}"

    def after_step(self, iteration: int, decrement: float) -> str:
        """The same of a solver by its expected decrease, which falls by about the same factor each
        iteration when it comes near its end; "" while it does not fall, and where it is too early
        to tell."""
        if iteration <= 1:
            self._steps.clear()
        now = self._clock()
        self._steps.append((now, math.log(max(decrement, 1e-300))))
        if now - self._began < FIRST or len(self._steps) < LAST or not decrement > ARRIVED:
            return ""
        (then, high), (_, low) = self._steps[-LAST], self._steps[-1]
        if not high - low > 0.1 * (LAST - 1):
            return ""
        return f", {in_words((now - then) * (low - math.log(ARRIVED)) / (high - low))}"


def onward(say: Callable[[str, float], None]) -> Callable[[str, float], None]:
    """`say` with shares that never fall: a search comes back to what it did before."""
    most = 0.0

    def said(text: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        say(text, most)

    return said


OFTEN = 0.2
"""[s] A line of a notebook moves no more often."""


class NotebookLine:
    """One line below a cell of a notebook that says what runs, how much of it is done and how long
    it will take.

    `display(data, id, update)` shows a bundle of MIME types (default: IPython's).
    """

    def __init__(
        self,
        title: str,
        display: Callable[[dict[str, str], str, bool], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._display, self._clock = title, display, clock
        self._began = clock()
        self._shown = -math.inf
        self._id = f"greybox-{id(self)}-{time.time_ns()}"
        self._left = TimeLeft(clock)
        self._first = True

    def say(self, text: str) -> None:
        """A line of text; how much is done is not known."""
        self._show(text, None)

    def share(self, text: str, share: float) -> None:
        """What runs, and the share of all (0 to 1) that is done."""
        self._show(f"{text}{self._left.after(share)}", share)

    def solver(self, iteration: int, cost: float, decrement: float) -> None:
        """An iteration of a solver."""
        rest = self._left.after_step(iteration, decrement)
        self._show(f"iteration {iteration}, cost {cost:.6g}{rest}", None)

    def end(self, how: str) -> None:
        """The last that is said: how it ended and how long it took."""
        self._shown = -math.inf
        self._show(
            f"{how} after {self._clock() - self._began:.0f} s", 1.0 if how == "done" else None
        )

    def _show(self, text: str, share: float | None) -> None:
        now = self._clock()
        if now - self._shown < OFTEN:
            return
        self._shown = now
        plain = f"{self._title}: {text.strip()}"
        value = "" if share is None else f' value="{min(max(share, 0.0), 1.0):.3f}"'
        bar = f'<progress{value} aria-label="{html.escape(self._title)}" style="width: 12em"></progress> '
        # A bar without a value moves for ever: what ended otherwise has none.
        bar = "" if share is None and text.startswith("stopped") else bar
        self._display(
            {"text/plain": plain, "text/html": f"<div>{bar}{html.escape(plain)}</div>"},
            self._id,
            not self._first,
        )
        self._first = False


def notebook_line(title: str) -> NotebookLine | None:
    """A line in the notebook that this runs in; None elsewhere."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if not hasattr(shell, "kernel"):
        return None
    from IPython.display import display

    def show(data: dict[str, str], name: str, update: bool) -> None:
        display(data, raw=True, display_id=name, update=update)

    return NotebookLine(title, show)


def in_notebooks(**ways: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of long work: in a notebook, where the caller gave no way to hear of it, a line
    shows it.

    `ways` maps keywords of the function to the method of `NotebookLine` that each is given.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def shown(*args: P.args, **kwargs: P.kwargs) -> R:
            line = (
                None
                if any(kwargs.get(k) is not None for k in ways)
                else notebook_line(function.__name__)
            )
            if line is None:
                return function(*args, **kwargs)
            own = {k: getattr(line, method) for k, method in ways.items()}
            how = "stopped"
            try:
                result = function(*args, **{**kwargs, **own})
                how = "done"
            finally:
                line.end(how)
            return result

        return shown

    return decorate
