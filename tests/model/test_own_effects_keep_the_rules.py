"""Effects from a user's file: the same class, held to the same basics, each mistake answered in one
line."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from craft import X250, flat, function, vector, vehicle_of

from greybox.errors import FileFormatError, ModelError
from greybox.model.effect_check import check_effect
from greybox.model.effects import CATALOGUE
from greybox.model.effects_file import effects_of, load_effects, own_effects
from greybox.model.model import PhysicsModel, build_model
from greybox.model.vehicle_parts import Quantity

GOOD = """
import casadi as ca
from greybox.model.effect import Effect
from greybox.model.parameter import Parameter

class Magnet(Effect):
    name = "magnet"
    stage = "wrench"
    summary = "torque of a magnet in the field of the earth"
    formula = "tau = m (e_x x R^T b)"

    def parameters(self, vehicle):
        return (Parameter(name="m", unit="N m", nominal=0.0, null=0.0, scale=1e-3, meaning="moment"),)

    def apply(self, flow, p):
        return {"moment": p["m"] * ca.cross(ca.DM([1, 0, 0]), flow.rotation.T @ ca.DM([0, 1, 0]))}
"""
COLUMNS = ("qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az")


@pytest.fixture
def file(tmp_path):
    def write(text=GOOD, name="magnet.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("effect", [pytest.param(e, id=e.name) for e in CATALOGUE])
def test_every_effect_of_the_catalogue_passes_the_check(effect):
    check_effect(effect)


def test_an_own_effect_is_felt_and_gone_at_its_null(file):
    (magnet,) = load_effects(file())
    assert magnet.name == "magnet"
    model = build_model(vehicle_of(X250), COLUMNS, ["motor_lag", magnet])
    assert [e.name for e in model.effects] == ["motor_lag", "magnet"]
    x, u = model.reference({}), [0.5] * 4
    x[model.states["attitude.w"]], x[model.states["attitude.z"]] = np.cos(0.3), np.sin(0.3)
    f = function(model, "f")
    turned = flat(f(x, u, vector(model, magnet__m=2e-3))) - flat(
        f(x, u, vector(model, magnet__m=0.0))
    )
    # Yawed by 0.6 rad to the left, north is at sin, cos of that in body axes: tau = m (0, 0, cos
    # 0.6).
    expected = 2e-3 * np.cos(0.6) / X250.inertia[2]
    assert turned[model.states["rate.z"]] == pytest.approx(expected, rel=1e-9)
    assert np.count_nonzero(np.abs(turned) > 1e-15) == 1
    assert model.without_effect("magnet") == build_model(vehicle_of(X250), COLUMNS, ["motor_lag"])


def test_the_vehicle_file_may_state_it(file):
    (magnet,) = load_effects(file())
    vehicle = replace(vehicle_of(X250), effects={"magnet": {"m": Quantity(value=1e-3, sigma=1e-4)}})
    model = build_model(vehicle, COLUMNS, [magnet])
    (m,) = (p for p in model.parameters if p.name == "magnet.m")
    assert (m.nominal, m.sigma) == (1e-3, 1e-4)


def test_the_same_text_is_the_same_effect_here_and_after_a_pickle(file):
    (one,) = load_effects(file())
    (two,) = load_effects(file(name="copy.py"))
    assert one is two
    assert pickle.loads(pickle.dumps(one)) is one


def test_another_process_can_take_it(file, tmp_path):
    (magnet,) = load_effects(file())
    (tmp_path / "e.pickle").write_bytes(pickle.dumps(magnet))
    code = "import pickle, sys; print(pickle.load(open(sys.argv[1], 'rb')).name)"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "e.pickle")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "magnet"


def test_two_effects_of_one_name_are_refused(file):
    (one,) = load_effects(file())
    (other,) = load_effects(
        file(GOOD.replace("torque of a magnet", "the torque of a magnet"), "b.py")
    )
    with pytest.raises(ModelError, match="two effects are named magnet"):
        build_model(vehicle_of(X250), COLUMNS, [one, other])


def changed(*pairs):
    text = GOOD
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


BODY = 'return {"moment": p["m"] * ca.cross(ca.DM([1, 0, 0]), flow.rotation.T @ ca.DM([0, 1, 0]))}'
WRONG = {
    "no effect in the file": "x = 1\n",
    r":2: not valid Python": "\ndef broken(:\n",
    r"magnet.py:3: running the file: ZeroDivisionError": "\n\n1 / 0\n",
    "class Magnet lacks formula": changed(("    formula =", "    formla =")),
    "class Magnet lacks apply": changed(("    def apply(", "    def aply(")),
    "effect rotor_drag is in the catalogue": changed(('"magnet"', '"rotor_drag"')),
    "two effects are named magnet": GOOD + GOOD.replace("class Magnet", "class Other"),
    "bad name": changed(('"magnet"', '"My Magnet"')),
    "unknown stage 'wench'": changed(('"wrench"', '"wench"')),
    "parameter m has no null": changed(("null=0.0, ", "")),
    "no null within its bounds": changed(
        ("null=0.0", "null=0.0, lower=1.0, upper=2.0"), ("nominal=0.0", "nominal=1.5")
    ),
    "must give a tuple of Parameter": changed(
        ("return (Parameter", "return [Parameter"), ('"moment"),)', '"moment")]')
    ),
    "returns torque; expected what stage wrench knows": changed(('"moment": p', '"torque": p')),
    r"magnet.py:16: effect magnet, apply: AttributeError": changed(
        ("flow.rotation", "flow.rotatoin")
    ),
    r"magnet.py:16: effect magnet, apply: KeyError": changed(('p["m"]', 'p["n"]')),
    "does not vanish at its null": changed(('p["m"] * ca', '(1e-3 + p["m"]) * ca')),
    "not finite": changed(('p["m"] * ca', 'p["m"] / (flow.velocity[0] * 0) * ca')),
    r"early = frozenset\(\['wind'\]\)": changed(
        (BODY, 'return {"wind": p["m"] * ca.DM([1, 0, 0])}')
    ),
    "effect magnet: effect magnet needs missing_fact": changed(
        (
            "    def parameters",
            "    needs = Needs(vehicle=('missing_fact',))\n\n    def parameters",
        ),
        ("import Effect", "import Effect, Needs"),
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_mistake_in_the_file_is_one_clear_line(message, file):
    path = file(WRONG[message])
    for _ in range(2):  # a file that failed is not remembered
        with pytest.raises(ModelError, match=message) as error:
            load_effects(path)
    assert "magnet.py" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ModelError, match="no such effects file"):
        load_effects(tmp_path / "absent.py")
    with pytest.raises(ModelError, match="cannot read"):
        load_effects(tmp_path)


LAG = """
from greybox.model.effect import Effect
from greybox.model.parameter import Parameter

class SlowMotor(Effect):
    name = "slow_motor"
    stage = "rotor"
    summary = "a lag of my own"
    formula = "dnu/dt = (nu_ss - nu) / (2 tau)"
    early = frozenset({"lag"})

    def parameters(self, vehicle):
        return (Parameter(name="tau", unit="s", nominal=0.02, lower=0.0, upper=0.2, null=0.0, scale=0.01),)

    def apply(self, flow, p):
        return {"lag": 2 * p["tau"]}
"""


def test_an_own_lag_brings_rotor_states_and_stands_alone(file):
    (slow,) = load_effects(file(LAG))
    model = PhysicsModel(vehicle=vehicle_of(X250), effects=(slow,))
    assert "rotor.4" in model.states
    reference = PhysicsModel(vehicle=vehicle_of(X250)).with_effect("motor_lag")
    x, u = model.reference({}), np.array([[0.6, 0.5, 0.4, 0.7]]).T
    step = flat(
        function(model, "step")(x, u, vector(model, slow_motor__tau=0.02), np.zeros(6), 0.01)
    )
    same = flat(
        function(reference, "step")(x, u, vector(reference, motor_lag__tau=0.04), np.zeros(6), 0.01)
    )
    np.testing.assert_allclose(step, same, rtol=1e-12, atol=1e-12)
    with pytest.raises(ModelError, match="two lags"):
        model.with_effect("motor_lag")


def test_a_model_file_names_the_effects_file_that_it_needs(file):
    (magnet,) = load_effects(file())
    own = own_effects((*CATALOGUE, magnet))
    assert set(own) == {"magnet"}
    assert own["magnet"]["file"] == "magnet.py"
    names = ["motor_lag", "magnet"]
    assert effects_of(names, own, [magnet], where="m.json")[1] is magnet
    with pytest.raises(
        FileFormatError,
        match=r"m.json: .*magnet \(magnet.py\).*--effects-file magnet.py.*load_effects",
    ):
        effects_of(names, own, [], where="m.json")
    (other,) = load_effects(file(GOOD + "# changed since\n"))
    with pytest.raises(FileFormatError, match="not the one that the model was made with"):
        effects_of(names, own, [other], where="m.json")


def test_an_effect_of_ones_own_code_is_asked_for_too():
    class Mine(type(CATALOGUE[0])):
        name = "mine"

    own = own_effects([Mine()])
    assert own["mine"]["file"] is None
    with pytest.raises(FileFormatError, match="Python code of your own"):
        effects_of(["mine"], own, [], where="m.json")
    assert effects_of(["mine"], own, [Mine()], where="m.json")[0].name == "mine"


def test_all_files_that_a_model_needs_are_named_at_once_by_their_place(tmp_path):
    (tmp_path / "one.py").write_text("")
    own = {n: {"file": f"{n}.py", "sha256": None, "references": []} for n in ("one", "two")}
    with pytest.raises(FileFormatError) as refused:
        effects_of(["one", "rotor_drag", "two"], own, [], where=str(tmp_path / "m.json"))
    assert f"--effects-file {tmp_path / 'one.py'} two.py" in str(refused.value)
