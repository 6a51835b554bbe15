"""`--mcap` writes what viewers read without a set-up: types are Foxglove's own, Rerun makes
transforms and texts of them, a reader that is not ours gets the same numbers, and these are those
of the flight."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.logs import read_logs
from greybox.data.readers.protobuf import decode, described
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.identified import IdentifiedModel
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import plant
from tests.data.readers.writers import px4_attitude

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("mcap") is None, reason="the extra `logs` is not installed"
    ),
]
Messages = list[tuple[float, dict[str, Any]]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a recording of Flüge")
    true_plant = plant()
    log = fly(
        true_plant,
        controller_for(true_plant),
        Hover(),
        rich_excitation(),
        3.0,
        seed=[1, 2],
        warm_up=0.5,
    )
    write_log(folder / "a.csv", member(log, 0), drop=["omega"])
    write_log(folder / "b.csv", member(log, 1), drop=["omega"])
    write_vehicle(folder / "v.toml", true_plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    words = [
        "--vehicle",
        str(folder / "v.toml"),
        "--train",
        str(folder / "a.csv"),
        "--test",
        str(folder / "b.csv"),
    ]
    effects = "motor_lag,command_delay,rotor_drag,rotational_damping"
    code = main(
        [
            "fit",
            *words,
            "--manual",
            "--effects",
            effects,
            "--disturbance",
            "force,torque",
            "--out",
            str(folder / "fit"),
            "--mcap",
            str(folder / "fit.mcap"),
        ]
    )
    assert code in (0, 1)
    return folder


def read(path: Path) -> dict[str, Messages]:
    """Topic -> (seconds, message), every message by the types that the file carries."""
    from mcap.reader import make_reader

    found: dict[str, Messages] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            content = decode(described(schema.data), schema.name, message.data)
            stamp = content["timestamp"]
            assert stamp["seconds"] * 10**9 + stamp["nanos"] == message.log_time
            found.setdefault(channel.topic, []).append((message.log_time / 1e9, content))
    return found


@pytest.fixture(scope="module")
def messages(run: Path) -> dict[str, Messages]:
    return read(run / "fit.mcap")


def test_every_flight_has_its_poses_innovations_pushes_and_events(messages: dict[str, Messages]):
    kinds = {f"{k}/pose" for k in ("measured", "one_step_ahead", "ahead")} | {
        f"{k}/path" for k in ("measured", "one_step_ahead", "ahead")
    }
    kinds |= {"innovations", "force", "torque"}
    for flight in ("a", "b"):
        assert {
            t.removeprefix(f"/{flight}/") for t in messages if t.startswith(f"/{flight}/")
        } >= kinds
    assert {"/a/measured/tf", "/b/ahead/tf"} <= set(messages)


def test_measured_poses_are_those_of_the_log(run: Path, messages: dict[str, Messages]):
    model = IdentifiedModel.load(run / "fit" / "model.json")
    segment = (
        read_logs([run / "a.csv"], model.physics.vehicle, rate=1 / model.sample_time)
        .flights[0]
        .segments[0]
    )
    got = messages["/a/measured/pose"]
    x = np.interp([t for t, _ in got], segment.t, segment.channels["x"])
    np.testing.assert_allclose([m["pose"]["position"]["x"] for _, m in got], x, atol=1e-6)
    turns = np.array([[m["pose"]["orientation"][k] for k in "wxyz"] for _, m in got])
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, atol=1e-9)


def test_what_was_said_half_a_second_before_is_worse_than_a_step_before(
    messages: dict[str, Messages],
):
    measured = {t: m["pose"]["position"] for t, m in messages["/b/measured/pose"]}

    def error(kind: str) -> float:
        pairs = [
            (m["pose"]["position"], measured[t])
            for t, m in messages[f"/b/{kind}/pose"]
            if t in measured
        ]
        return float(np.mean([np.hypot(p["x"] - q["x"], p["z"] - q["z"]) for p, q in pairs]))

    assert error("one_step_ahead") < error("ahead") < 0.3
    assert messages["/b/ahead/pose"][0][0] == pytest.approx(
        messages["/b/one_step_ahead/pose"][0][0] + 0.5, abs=0.02
    )


def test_the_band_of_force_holds_its_value(messages: dict[str, Messages]):
    for topic, width in (("/a/force", 1.0), ("/a/torque", 0.1)):
        for _, m in messages[topic]:
            for axis in "xyz":
                assert m["low"][axis] < m["value"][axis] < m["high"][axis]
                assert m["high"][axis] - m["low"][axis] < width


def test_the_summary_tells_every_channel_and_its_type(run: Path):
    """PlotJuggler opens the summary alone, takes the parser by the encoding of the messages, and
    the time of publication."""
    from mcap.reader import make_reader

    with (run / "fit.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert {c.message_encoding for c in summary.channels.values()} == {"protobuf"}
    for channel in summary.channels.values():
        assert summary.statistics.channel_message_counts[channel.id] > 0
        assert summary.schemas[channel.schema_id].name in described(
            summary.schemas[channel.schema_id].data
        )


def test_another_reader_gets_the_same_numbers(run: Path, messages: dict[str, Messages]):
    pytest.importorskip("mcap_protobuf", reason="pip install mcap-protobuf-support")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    count = 0
    with (run / "fit.mcap").open("rb") as stream:
        for _, channel, _, theirs in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            if channel.topic == "/b/measured/pose":
                ours = messages[channel.topic][count][1]["pose"]["position"]
                assert (theirs.pose.position.x, theirs.pose.position.z) == (ours["x"], ours["z"])
                count += 1
    assert count == len(messages["/b/measured/pose"])


def test_rerun_makes_transforms_and_texts_of_it(run: Path):
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("pip install rerun-sdk")
    words = [rerun, "mcap", "check", "--full", run / "fit.mcap"]
    checked = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "PROBLEM" not in checked.stdout
    subprocess.run(
        [rerun, "mcap", "convert", run / "fit.mcap", "-o", run / "fit.rrd"],
        capture_output=True,
        check=True,
    )
    seen = subprocess.run(
        [rerun, "rrd", "print", run / "fit.rrd"], capture_output=True, text=True, check=True
    ).stdout
    for topic, what in (
        ("measured/tf", "Transform3D:quaternion"),
        ("measured/path", "InstancePoses3D:translations"),
        ("events", "TextLog:text"),
        ("innovations", "greybox.Innovations:message"),
    ):
        assert [line for line in seen.splitlines() if f"/a/{topic} " in line and what in line], (
            topic
        )
    assert "McapMessage:data" not in seen  # nothing is left as bytes


def test_validate_writes_one_too_and_greybox_reads_its_own(
    run: Path, capsys: pytest.CaptureFixture[str]
):
    target = run / "seen.mcap"
    words = ["validate", str(run / "fit" / "model.json"), "--log", str(run / "b.csv")]
    assert main([*words, "--mcap", str(target)]) in (0, 1)
    assert "/b/innovations" in read(target)
    assert main(["inspect", str(target)]) in (0, 1)
    assert "/b/measured/pose" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["seen.bag", "there/no.mcap"])
def test_a_recording_that_cannot_be_is_refused_before_any_work(
    run: Path, name: str, capsys: pytest.CaptureFixture[str]
):
    words = ["validate", str(run / "fit" / "model.json"), "--log", str(run / "b.csv"), "--mcap"]
    if "/" in name:
        (run / "there").write_text("a file, not a folder")
    assert main([*words, str(run / name)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_flight_review_gets_attitude_rate_and_place_as_px4_would_log_them(
    run: Path, capsys: pytest.CaptureFixture[str]
):
    """pyulog, on which Flight Review stands, reads the log; its roll, pitch and yaw are those of
    rotation matrices."""
    pyulog = pytest.importorskip("pyulog")
    from pyulog.px4 import PX4ULog

    target = run / "b.ulg"
    words = ["validate", str(run / "fit" / "model.json"), "--log", str(run / "b.csv")]
    assert main([*words, "--ulog", str(target)]) in (0, 1)
    log = pyulog.ULog(str(target))
    assert not log.file_corruption
    assert PX4ULog(log).get_mav_type() == "Quadrotor"
    PX4ULog(log).add_roll_pitch_yaw()
    topics = {d.name: d.data for d in log.data_list}
    assert "b" in log.logged_messages[0].message
    model = IdentifiedModel.load(run / "fit" / "model.json")
    c = (
        read_logs([run / "b.csv"], model.physics.vehicle, rate=1 / model.sample_time)
        .flights[0]
        .segments[0]
        .channels
    )
    truth = topics["vehicle_attitude_groundtruth"]
    np.testing.assert_allclose(np.diff(truth["timestamp"]), 1e6 * model.sample_time, atol=1.0)
    theirs = np.column_stack([truth[f"q[{i}]"] for i in range(4)])
    ours = px4_attitude(c)
    np.testing.assert_allclose(np.abs((theirs * ours).sum(axis=1)), 1.0, atol=1e-5)
    place = topics["vehicle_local_position_groundtruth"]
    for name, ned in zip("xyz", (c["y"], c["x"], -c["z"]), strict=True):
        np.testing.assert_allclose(place[name], ned, atol=1e-5)
    np.testing.assert_allclose(
        topics["vehicle_angular_velocity_groundtruth"]["xyz[1]"], -c["q"], atol=1e-5
    )
    # The estimate is the model's, half a second ahead: near, not the same.
    off = np.rad2deg(topics["vehicle_attitude"]["roll"] - truth["roll"])
    assert 0.01 < np.sqrt(np.nanmean(((off + 180) % 360 - 180) ** 2)) < 20
    capsys.readouterr()
    assert main(["inspect", str(target)]) == 2
    assert "predictions of a model" in capsys.readouterr().err
    assert main([*words, "--ulog", str(run / "b.csv")]) == 2
