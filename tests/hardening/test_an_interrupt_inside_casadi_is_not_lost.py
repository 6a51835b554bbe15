"""CasADi drops what its conversions of operands raise; an interrupt that arrives there comes again
after them."""

from __future__ import annotations

import signal
import time

import casadi as ca
import pytest

from greybox.interrupts import kept_interrupts


class PressesCtrlC:
    """An operand whose conversion is interrupted."""

    def tocsc(self) -> PressesCtrlC:
        signal.raise_signal(signal.SIGINT)
        return self


@pytest.fixture(autouse=True)
def as_python_starts() -> object:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def multiply() -> None:
    with pytest.raises(
        (NotImplementedError, TypeError)
    ):  # it is no matrix, which is all that CasADi says
        ca.SX.sym("x") * PressesCtrlC()


def test_casadi_alone_drops_it() -> None:
    multiply()
    time.sleep(0.05)


def test_it_comes_after_the_conversion() -> None:
    def work() -> None:
        with kept_interrupts():
            multiply()
            time.sleep(5)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_elsewhere_it_comes_at_once() -> None:
    def work() -> None:
        with kept_interrupts():
            signal.raise_signal(signal.SIGINT)
            pytest.fail("it did not come")

    with pytest.raises(KeyboardInterrupt):
        work()


def test_a_handler_of_the_caller_stays() -> None:
    asked: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: asked.append(number))
    with kept_interrupts():
        signal.raise_signal(signal.SIGINT)
    assert asked == [signal.SIGINT]
