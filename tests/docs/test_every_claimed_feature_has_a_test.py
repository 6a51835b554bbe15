"""Every word of README's list of features, and every command, stands in a table with a test that
proves it.

Exports and consumers have a table of their own, word by word: test_export_claims_are_tested.py.
"""

from __future__ import annotations

import re

import pytest

from greybox.cli import COMMANDS
from tests.docs.pages import ROOT

README = (ROOT / "README.md").read_text()
LIST = README.split("## What it does")[1].split("```text")[0]
READERS = "tests/data/readers/test_each_reader_knows_its_system.py"
ELSEWHERE = ("Export", "Consumers")

CLAIMS: dict[str, dict[str, str]] = {
    "Logs": {
        "PX4": "tests/cli/test_a_px4_log_goes_from_inspect_to_discover.py",
        **dict.fromkeys(
            ("ROS", "Betaflight", "ArduPilot", "Crazyflie", "MATLAB", "Parquet"), READERS
        ),
        "CSV as they come": "tests/data/test_csv_reader_keeps_every_value.py",
        "greybox inspect says what a log holds and lacks": "tests/cli/test_inspect_tells_what_a_log_is_good_for.py",
        "greybox check finds faults": "tests/cli/test_check_reports_to_people_and_machines.py",
        "(units, frames, motor order, clocks) before they become physics": "tests/data/"
        "test_injected_faults_are_found_and_clean_flights_pass.py",
    },
    "Before a flight": {
        "greybox vehicle writes and judges vehicle files": "tests/cli/test_vehicle_files_are_written_and_judged.py",
        "greybox plan proposes flights": "tests/cli/test_plan_writes_flights_and_what_to_expect.py",
        "with the standard error to expect": "tests/planning/test_planned_errors_are_the_spread_of_fits.py",
    },
    "Fit": {
        "Newton-Euler in CasADi": "tests/model/test_rigid_body_obeys_newton_and_euler.py",
        "with named effects": "tests/conformance/test_effects_reproduce_their_case_by_hand.py",
        "exact sensitivities compiled to C": "tests/estimation/test_engine_gives_exact_sensitivities.py",
        "standard errors that survive coloured innovations": "tests/estimation/test_fit_says_how_sure_it_is.py",
    },
    "Your own model": {
        "effect": "tests/cli/test_own_effects_from_a_file.py",
        "sensor": "tests/claims/test_a_new_sensor_is_one_class.py",
        "learner": "tests/conformance/test_every_learner_keeps_the_protocol.py",
        "by the same commands": "tests/cli/test_own_models_and_profiles_from_the_command_line.py",
    },
    "Linear models": {"greybox linear": "tests/linear/test_linear_command.py"},
    "Frequency response": {
        "greybox frf": "tests/cli/test_frf_measures_flights_and_says_what_it_cannot.py",
        "with coherence, 95 % bands": "tests/statistics/test_frequency_responses_have_honest_bands.py",
        "gain and lag": "tests/linear/test_frequency_responses_of_flights.py",
    },
    "What is missing": {
        "greybox discover names it": "tests/discovery/test_discover_names_what_is_hidden.py",
        "each name with an e-value from flights that did not propose it": "tests/discovery/"
        "test_certificates_keep_their_level.py",
    },
    "What is left": {
        "greybox learn learns the remaining force and torque": "tests/residual/test_learn_helps_and_does_no_harm.py",
        "with an uncertainty that holds": "tests/claims/test_hybrid_knows_how_sure_it_is.py",
        "greybox compare puts linear PEM, LSTM, TCN, GP alone and both hybrids into one table": "tests/baselines/"
        "test_comparisons_judge_all_alike.py",
    },
    "Digital twin": {
        "greybox twin writes the same craft for": "tests/cli/test_twin_writes_simulators_and_refuses.py",
        "RotorPy": "tests/simulators/test_rotorpy_flies_what_the_model_flies.py",
        "MuJoCo": "tests/simulators/test_mujoco_flies_what_the_model_flies.py",
        "crazyflow": "tests/simulators/test_drone_models_fly_what_the_statement_says.py",
        **dict.fromkeys(
            ("PyBullet", "Gazebo", "PX4", "ArduPilot", "Isaac"),
            "tests/simulators/test_written_numbers_give_the_wrench.py",
        ),
        "FlightGoggles": "tests/simulators/test_written_numbers_give_the_wrench.py",
        "JSBSim": "tests/simulators/test_simulators_fly_the_model_with_the_rest.py",
        "NumPy and JAX": "tests/simulators/test_the_module_is_the_model.py",
    },
    "Control": {
        "a tube MPC in C": "tests/mpc_export/tube/test_controller_flies_and_survives.py",
        "keeps limits": "tests/mpc_export/mission/test_mpc_flights_are_counted_honestly.py",
        "that are tightened by what the model does not know": "tests/mpc_export/tube/"
        "test_tube_is_the_spread_of_the_closed_loop.py",
        "greybox mpc flies it": "tests/cli/test_mpc_flies_resumes_and_refuses.py",
    },
}
POINTERS = ("How it works", "How it decides")
"""Links to a page that claim nothing."""

COMMAND_TESTS = {
    **{
        c: f"tests/cli/{t}.py"
        for c, t in {
            "identify": "test_identify_runs_resumes_and_refuses",
            "vehicle": "test_vehicle_files_are_written_and_judged",
            "plan": "test_plan_writes_flights_and_what_to_expect",
            "inspect": "test_inspect_tells_what_a_log_is_good_for",
            "check": "test_check_reports_to_people_and_machines",
            "fit": "test_bad_input_to_fit_and_validate",
            "validate": "test_bad_input_to_fit_and_validate",
            "profile": "test_own_models_and_profiles_from_the_command_line",
            "frf": "test_frf_measures_flights_and_says_what_it_cannot",
            "learn": "test_learn_takes_linear_models_too",
            "discover": "test_discover_writes_what_it_finds",
            "export": "test_export_writes_bundles",
            "twin": "test_twin_writes_simulators_and_refuses",
            "mpc": "test_mpc_flies_resumes_and_refuses",
            "demo": "test_the_demo_runs_without_a_checkout",
            "selftest": "test_selftest_says_what_works_and_what_to_do",
            "completion": "test_the_command_line_is_light_quiet_and_completes",
        }.items()
    },
    "linear": "tests/linear/test_linear_command.py",
    "compare": "tests/baselines/test_comparisons_judge_all_alike.py",
    "effects": "tests/conformance/test_catalogue_is_listed_as_declared.py",
    "examples": "tests/examples/test_shipped_flights_are_whole_and_licensed.py",
    "cite": "tests/cli/test_own_effects_from_a_file.py",
}


def bullets(text: str) -> dict[str, str]:
    """Title -> the rest of each point, without marks of links and code, on one line."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(text.split())).replace("`", "")
    found = re.findall(r"- \*\*(.*?)\*\*[:,]? (.*?)(?= - \*\*|$)", plain)
    return dict(found)


def unproven(text: str, claims: dict[str, str]) -> list[str]:
    """Words of a point that no claim holds, and claims that it does not make."""
    absent = [c for c in claims if c not in text]
    for phrase in (*sorted(claims, key=len, reverse=True), *POINTERS):
        text = re.sub(rf"(?<!\w){re.escape(phrase)}(?!\w)", " ", text)
    return absent + [w for w in re.findall(r"[\w%-]+", text) if w not in ("and", "or")]


def test_every_word_of_every_feature_is_a_claim_with_a_test() -> None:
    features = bullets(LIST)
    assert sorted(features) == sorted([*CLAIMS, *ELSEWHERE])
    assert {t: left for t, c in CLAIMS.items() if (left := unproven(features[t], c))} == {}


def test_a_claim_that_is_added_or_taken_away_is_found() -> None:
    claims = CLAIMS["Control"]
    text = bullets(LIST)["Control"]
    assert unproven(text + " on a toaster", claims) == ["on", "a", "toaster"]
    assert unproven(text.replace("keeps limits", ""), claims) == ["keeps limits"]


@pytest.mark.parametrize("title", CLAIMS)
def test_the_tests_are_there_and_test_something(title: str) -> None:
    for file in CLAIMS[title].values():
        assert (ROOT / file).exists(), file
        assert re.search(r"^def test_", (ROOT / file).read_text(), re.MULTILINE), file
    for tool, file in CLAIMS[title].items():
        if re.fullmatch(r"[A-Z]\w+|crazyflow", tool):  # a name alone: of a format or a simulator
            assert tool.lower() in (ROOT / file).read_text().lower(), tool


def test_every_command_has_a_test_that_runs_it() -> None:
    listed = set(re.findall(r"greybox (\w+)", README.split("```text")[-1].split("```")[0]))
    assert listed <= set(COMMANDS)
    assert sorted(COMMAND_TESTS) == sorted(COMMANDS)
    assert [f for f in COMMAND_TESTS.values() if not (ROOT / f).exists()] == []
    # The word stands in the test as an argument, or as part of a command line.
    runs = {
        c: re.search(rf'"{c}"|[" ]{c} ', (ROOT / f).read_text()) for c, f in COMMAND_TESTS.items()
    }
    assert [c for c, found in runs.items() if not found] == []
