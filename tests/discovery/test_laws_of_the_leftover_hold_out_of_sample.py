"""What is left over is called a law only where a few signals explain it on flights that were left
out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greybox.discovery.left import _raced
from greybox.discovery.rules import RULES
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import fit
from greybox.estimation.gain import Linearisation
from greybox.frames import numeric
from greybox.model.model import build_model
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.bends import Bends
from greybox.residual.laws.found import is_law, laws_of
from greybox.residual.laws.normal_equations import Normal, solve
from greybox.residual.laws.responses import Library, Pushed, noise_scales, responses, stretches
from greybox.residual.laws.selection import forward, left_out, select
from greybox.residual.laws.terms import terms
from tests.discovery.small_world import damped, flown, law_of, vehicle

NAMES = (
    "body_velocity.x",
    "body_velocity.y",
    "p",
    "q",
    "position.z",
    "attitude.w",
    "attitude.x",
    "attitude.y",
    "attitude.z",
    "u1",
    "u2",
    "u3",
    "u4",
)


def signals(n: int = 400, seed: int = 0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Slow signals of two flights that yaw on the spot, (n, 13), and the flight of every row."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n + 40, len(NAMES)))
    z = np.stack([np.convolve(c, np.ones(40) / 40, "valid")[:n] for c in white.T], axis=1) * 5
    z[:, NAMES.index("position.z")] = 1.0 + 0.4 * np.tanh(z[:, NAMES.index("position.z")])
    half = 1.5 * z[:, NAMES.index("attitude.z")]
    z[:, 5:9] = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    z[:, 9:] = 0.6 + 0.05 * np.tanh(z[:, 9:])
    return z, ("a",) * (n // 2) + ("b",) * (n - n // 2)


def law(
    y: np.ndarray, z: np.ndarray, flights: tuple[str, ...], seed: int = 0, bent: str | None = None
) -> Axis:
    """The law of a torque that is seen as it is, in noise of its own size; `bent`: the term that a
    change of a number of the fit does the same as."""
    columns = [("torque.z", t) for t in terms("torque.z", NAMES, z, vehicle())]
    x = np.column_stack([t.values for _, t in columns])
    size = float(y.std()) or 1.0
    parts, owners = [], []
    for name in dict.fromkeys(flights):
        begin, n = flights.index(name), flights.count(name)
        for part in stretches(n, len(set(flights))):
            parts.append(slice(begin + part.start, begin + part.stop))
            owners.append(name)
    slopes = [t.values for _, t in columns if t.text == bent]
    x = np.column_stack([x, np.ones(len(x)), *slopes])
    whole = Normal.of([x[p] for p in parts], [y[p] for p in parts], owners)
    x[:, len(columns) + 1 :] *= -1  # innovations are what was measured less what was foretold
    seen = Normal.of([x[p] / size for p in parts], [y[p] / size for p in parts], owners)
    offered = Library(columns=columns, innovations=seen, smoothed={"torque.z": whole})
    found = laws_of(offered, len(y), seed)
    rms = float(np.sqrt(np.mean((y - y.mean()) ** 2)))
    return Axis(
        channel="torque.z",
        unit="N m",
        rms=rms,
        gain=100.0,
        lasts=1.0,
        needed=True,
        lawful=is_law(found.get("torque.z", {}), RULES.law),
        **found.get("torque.z", {}),
    )


def column(z: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(z[:, NAMES.index(name)])


def test_a_planted_law_is_written_down_with_its_coefficients():
    z, flights = signals()
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(z))
    north = 1 - 2 * column(z, "attitude.z") ** 2
    found = law(0.3 * north - 0.2 * column(z, "p") * np.abs(column(z, "p")) + noise, z, flights)
    assert found.lawful
    assert found.share > 0.9
    assert "p" in found.depends_on
    assert {"north.y", "east.x"} & set(found.depends_on)  # the same thing, of a level craft
    assert max(found.terms.get("north.y", 0), found.terms.get("east.x", 0)) == pytest.approx(
        0.3, abs=0.02
    )
    assert found.terms["p |p|"] == pytest.approx(-0.2, abs=0.02)
    assert found.to_dict()["proposal"].startswith("torque.z = ")


def test_a_product_of_two_signals_is_found():
    z, flights = signals(seed=4)
    y = column(z, "body_velocity.x") * column(z, "q") + 0.1 * np.random.default_rng(
        2
    ).standard_normal(len(z))
    found = law(y, z, flights)
    assert found.lawful
    assert set(found.depends_on) == {"velocity.x", "q"}


@pytest.mark.parametrize("colour", [1, 4])
def test_noise_has_no_law(colour: int):
    called = 0
    for seed in range(20):
        z, flights = signals(seed=seed)
        white = np.random.default_rng(500 + seed).standard_normal(len(z) + colour)
        found = law(np.convolve(white, np.ones(colour), "valid")[: len(z)], z, flights, seed)
        assert found.lawful == (bool(found.terms) and found.share >= RULES.law)
        called += found.lawful
    assert called <= 1


def test_what_turns_its_sign_between_flights_is_no_law():
    called = 0
    for seed in range(10):
        z, flights = signals(n=2000, seed=seed)
        y = np.where(np.array(flights) == "a", 1.0, -1.0) * column(z, "q")
        called += law(y, z, flights).lawful
    # By chance another signal may change its sign along.
    assert called <= 1


def test_a_mean_is_no_law_and_bends_none():
    z, flights = signals(n=2000, seed=3)
    found = law(
        2.0 + column(z, "q") + 0.7 * np.random.default_rng(6).standard_normal(len(z)), z, flights
    )
    assert set(found.terms) == {"q"}
    assert found.terms["q"] == pytest.approx(1.0, abs=0.05)


def test_what_a_number_of_the_fit_explains_is_no_law_nor_missed_by_one():
    z, flights = signals(n=4000, seed=5)
    (own,) = [t for t in terms("torque.z", NAMES, z, vehicle()) if t.text == "rotors.yaw"]
    y = 2 * np.std(column(z, "q")) / np.std(own.values) * own.values + column(z, "q")
    found = law(y, z, flights, bent="rotors.yaw")
    assert set(found.terms) == {"q"}
    assert found.share > 0.99


def test_nothing_left_is_nothing():
    z, flights = signals()
    found = law(np.zeros(len(z)), z, flights)
    assert (found.rms, found.terms, found.lawful) == (0.0, {}, False)
    assert found.to_dict()["proposal"] is None


def test_the_same_seed_gives_the_same_law():
    z, flights = signals()
    y = column(z, "q") + np.random.default_rng(3).standard_normal(len(z))
    assert law(y, z, flights, 5).to_dict() == law(y, z, flights, 5).to_dict()


def problem(n: int = 400, seed: int = 0) -> tuple[Normal, np.ndarray, np.ndarray]:
    """Normal equations of two flights, y = 2 x_1 - x_4 + noise, x_0 nearly x_1."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 6))
    x[:, 0] = x[:, 1] + 0.1 * x[:, 0]
    y = 2 * x[:, 1] - x[:, 4] + rng.standard_normal(n)
    parts = [slice(i, i + n // 10) for i in range(0, n, n // 10)]
    return Normal.of([x[p] for p in parts], [y[p] for p in parts], ["a"] * 5 + ["b"] * 5), x, y


def test_selection_is_least_squares_on_the_columns_that_matter():
    normal, x, y = problem()
    kept = select(normal, [], ["a"] * 6, most=3, samples=len(y), seed=0)
    assert set(kept) == {1, 4}
    direct = np.linalg.lstsq(x[:, kept], y, rcond=None)[0]
    assert solve(normal.xx.sum(0), normal.xy.sum(0), kept) == pytest.approx(direct, rel=1e-6)


def test_left_out_gain_is_what_it_says():
    normal, x, y = problem()
    total = 0.0
    for train, test in ((slice(0, 200), slice(200, 400)), (slice(200, 400), slice(0, 200))):
        c = np.linalg.lstsq(x[train][:, [1, 4]], y[train], rcond=None)[0]
        total += float((y[test] ** 2).sum() - ((y[test] - x[test][:, [1, 4]] @ c) ** 2).sum())
    assert left_out(normal, [1, 4]) == pytest.approx(total, rel=1e-6)


def test_what_is_always_in_is_not_chosen_again_and_explains_first():
    normal, _, _ = problem()
    xx, xy = normal.xx.sum(0), normal.xy.sum(0)
    assert forward(xx, xy, [1], ["a"] * 6, 3, 20.0) == [4]
    assert forward(xx, xy, [], ["a"] * 6, 1, 20.0) == [1]
    assert forward(xx, xy, [1, 4], ["a"] * 6, 3, 20.0) == []


def test_what_a_number_of_the_fit_does_is_in_every_law_from_the_start():
    """Against the filter itself, a number of its model changed."""
    data = flown(seconds=3.0)
    (segment,) = next(iter(data)).segments
    name, change = "inertia.xx", 1e-6
    found = fit(build_model(vehicle(), data.channels), data, free=[name], initialisation="noise")
    model = found.model
    runner, p = Filter(model), model.flight_vector(segment.flight)
    moved = p.copy()
    moved[[d.name for d in model.dynamics.parameters].index(name)] += change
    run, other = runner.run(segment, p=p), runner.run(segment, p=moved)
    white = np.linalg.inv(np.linalg.cholesky(run.covariance))[run.gains.pattern]
    slope = (other.innovations - run.innovations) / change
    expected = (np.einsum("nij,nj->ni", white, slope) ** 2).sum()
    lin, place = Linearisation(model.dynamics, ()), model.dynamics.noises["torque.x"]
    parts = [slice(0, segment.n // 2), slice(segment.n // 2, segment.n)]
    bends, pushes = Bends.of(model.dynamics, found.parameters), np.ones((segment.n, 1))
    pushed = Pushed(runner=runner, lin=lin, run=run, pushes=pushes, places=[place], bends=bends)
    blocks = responses(pushed, parts)
    # The gain depends on it, too, a little; that is left out.
    assert sum(b.xx[0][-1, -1] for b in blocks) == pytest.approx(expected, rel=1e-2)


def test_responses_are_what_a_force_does_to_the_innovations():
    """Against the filter itself, its model pushed by a small constant force."""
    data = flown(seconds=3.0)
    (segment,) = next(iter(data)).segments
    model = fit(
        build_model(vehicle(), data.channels, ["constant_force"]), data, initialisation="noise"
    ).model
    runner = Filter(model)
    p = model.flight_vector(segment.flight)
    moved = p.copy()
    names = [d.name for d in model.dynamics.parameters]
    places = [model.dynamics.noises[f"force.{a}"] for a in "xyz"]
    for j, axis in enumerate("xyz"):
        moved[:] = p
        moved[names.index(f"constant_force.f_{axis}")] -= 1e-3
        run, less = runner.run(segment, p=p), runner.run(segment, p=moved)
        q = run.states[:, [model.dynamics.states.names.index(f"attitude.{c}") for c in "wxyz"]]
        world = np.zeros((segment.n, 3))
        world[:, j] = 1e-3
        lin, pushes = Linearisation(model.dynamics, ()), numeric("rotate_inverse", q, world)
        # The first innovations are wider, until the filter has settled.
        white = np.linalg.inv(np.linalg.cholesky(run.covariance))[run.gains.pattern]
        change = np.einsum("nij,nj->ni", white, less.innovations - run.innovations)
        # The change on the sum of the three columns is a regression with coefficient one.
        moved_run = replace(run, innovations=less.innovations - run.innovations)
        given = Pushed(runner=runner, lin=lin, run=moved_run, pushes=pushes, places=places)
        (pushed,) = responses(given, [slice(0, segment.n)])
        xx, xy, yy = pushed.xx[0].sum(), pushed.xy[0].sum(), pushed.yy[0]
        assert yy == pytest.approx((change**2).sum(), rel=1e-9)
        assert yy > 1e-3
        assert yy - 2 * xy + xx < 1e-3 * yy


def test_channels_are_weighed_by_what_a_steady_push_leaves_of_them():
    """A thrust that lacks a third is steady, and what a law has of it small beside that: a fit with
    white noise takes the whole for noise."""
    data = flown(seconds=3.0)
    (segment,) = next(iter(data)).segments
    model = fit(build_model(vehicle(), data.channels), data, initialisation="noise").model
    runner, lin = Filter(model), Linearisation(model.dynamics, ())
    run, place = runner.run(segment), [model.dynamics.noises["force.z"]]
    bends, n = Bends.of(model.dynamics, {}), segment.n
    given = Pushed(runner=runner, lin=lin, run=run, pushes=np.ones((n, 1)), places=place)
    rows = given.rows([slice(0, n)])
    pushed = np.concatenate([out[:, :, 0] for _, _, out, _ in rows])
    deviations = np.sqrt(np.diagonal(run.covariance, axis1=1, axis2=2))[run.gains.pattern]
    noise = 0.1 * deviations * np.random.default_rng(0).standard_normal(deviations.shape)
    push = 30.0 / np.sqrt(((pushed / deviations) ** 2).mean(0).max())
    moved = replace(run, innovations=push * pushed + noise)
    there = run.gains.there[run.gains.pattern].any(axis=0)
    with_push = noise_scales(runner, lin, [moved], place, bends)
    assert with_push[there] == pytest.approx(0.1, rel=0.3)
    without = noise_scales(runner, lin, [moved], [], bends)
    assert without.max() == pytest.approx(30.0, rel=0.01)


def test_a_law_gets_its_own_fit_where_one_of_its_name_lost_before():
    flights, seen = damped(), []
    at, (z, _) = flights.fit(flights.causes.base), signals()
    for term in terms("torque.x", NAMES, z, vehicle())[:4:3]:
        law = law_of("torque.x", term)
        _raced(flights, at, (law,), [law], -np.inf, lambda laws: seen.append(laws) or False)
    assert seen[0].structure == seen[1].structure
    assert seen[0].value.likelihood != seen[1].value.likelihood


class _Readings:
    """A filter's run with white innovations of two channels, of which the last has `few`."""

    def __init__(self, few: int, n: int = 400) -> None:
        rng, self.out = np.random.default_rng(1), np.zeros((n, 2, 3))
        self.out[:] = rng.standard_normal((n, 2, 3))
        self.there = np.ones((n, 2))
        self.there[: n - few, 1] = 0
        self.target = rng.standard_normal((n, 2)) * [0.5, 1.0] * self.there
        self.out *= self.there[:, :, None]

    def scales(self, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
        rows = [(0, np.arange(len(self.there)), self.out, self.target)]
        monkeypatch.setattr(Pushed, "rows", lambda *_: iter(rows))
        gains = SimpleNamespace(there=self.there)
        run: Any = SimpleNamespace(
            innovations=self.target, covariance=np.tile(np.eye(2), (400, 1, 1)), gains=gains
        )
        nothing: Any = None
        return noise_scales(nothing, nothing, [run], [0, 1, 2], ())  # type: ignore[arg-type]


@pytest.mark.parametrize("few", [1, 2])
def test_a_channel_of_few_readings_is_no_channel_without_noise(few: int, monkeypatch):
    """Three columns meet two readings: at a scale of a millionth these would rule every law."""
    well, poor = _Readings(few).scales(monkeypatch)
    assert well == pytest.approx(0.5, rel=0.1)
    assert poor > 0.2


def test_channels_are_weighed_by_readings_not_by_how_many_there_are(monkeypatch):
    """What a few hundred readings say of a push is not bent by six of another channel."""
    seen = _Readings(6)
    seen.target[-6:, 1] *= 4.0
    c, *_ = np.linalg.lstsq(seen.out[:, 0], seen.target[:, 0])
    alone = np.sqrt(((seen.target[:, 0] - seen.out[:, 0] @ c) ** 2).mean())
    assert seen.scales(monkeypatch)[0] == pytest.approx(alone, rel=0.01)


def test_a_number_that_moves_no_reading_leaves_the_weights_as_they_are(monkeypatch):
    seen = _Readings(400)
    seen.out[:, :, 2] = 0.0
    assert seen.scales(monkeypatch) == pytest.approx([0.5, 1.0], rel=0.1)


def test_no_stretch_is_empty():
    assert [s.stop - s.start for s in stretches(3, 2)] == [1, 1, 1]
