"""What greybox promises to the people who use it, sentence by sentence, each with the test that
shows it.

The features of README have a table of their own (test_every_claimed_feature_has_a_test.py); this
one holds how it is to use them: installation, other systems, notebooks, pages, recordings,
documentation, words, progress, adoption.
"""

from __future__ import annotations

import json
import re
import tomllib

import pytest

from tests.docs.pages import ROOT

BROWSER = "report/test_pages_work_in_a_real_browser.py"
LEADS = "report/test_the_page_leads_with_its_result.py"
SHOWN = "shown/test_objects_show_themselves_in_twelve_lines.py"
NAME = "distribution/test_a_foreign_greybox_is_noticed.py"
OTHER = "packaging/test_what_other_systems_lack_is_not_needed.py"
HINTS = "packaging/test_hints_work_when_typed_as_printed.py"
MCAP = "cli/test_a_recording_shows_flights_beside_their_model.py"
TIME = "cli/test_the_time_left_is_said_and_shrinks.py"
PUBLIC = "claims/test_public_names_are_few_and_written_once.py"
SHORT = "docs/test_the_pages_stay_short.py"
COLUMNS = "data/readers/test_vehicle_files_and_mapping_files_speak_one_dialect.py"

PROMISES: dict[str, dict[str, str]] = {
    "A name of its own": {
        "hints name the distribution that there is": f"{NAME}::test_the_project_has_the_name_and_version_that_hints_give",
        "another greybox in the environment is said": f"{NAME}::test_it_is_noticed_and_said",
        "PyTorch's CPU build comes from its index": f"{NAME}::test_pytorch_comes_from_its_index_of_cpu_builds",
        "a wheel has two packages": "packaging/test_releases_install_and_run.py::test_nothing_but_the_packages_is_installed",
        "hints work as printed": f"{HINTS}::test_a_compiler_where_there_is_none",
        "flights come along, scenarios do not": f"{HINTS}::test_the_package_alone_has_no_scenarios_and_brings_its_flights",
        "every hint typed in an empty environment": f"{HINTS}::test_logs_of_other_systems",
        "every extra of a hint is declared": f"{NAME}::test_every_extra_that_a_hint_names_is_declared",
        "missions live in the package": "architecture/test_imports.py::test_what_is_installed_never_imports_scenarios",
        "the wheel installs and runs": "packaging/test_releases_install_and_run.py::test_it_installs_and_runs",
    },
    "Other systems": {
        "CR LF, blanks, other letters": f"{OTHER}::test_files_with_other_ends_of_lines_and_paths_are_the_same",
        "without POSIX": f"{OTHER}::test_commands_need_nothing_that_only_posix_has",
        "without a compiler, spawned": f"{OTHER}::test_a_fit_and_its_export_work_there",
        "read-only": f"{OTHER}::test_an_installation_that_cannot_be_written_serves",
        "without make": "cli/test_the_demo_runs_without_a_checkout.py::test_the_demo",
        "a compiler from a wheel": "estimation/test_a_compiler_may_come_as_a_wheel.py::"
        "test_with_an_empty_path_the_wheel_compiles",
        "encodings are said": f"{OTHER}::test_text_files_are_opened_with_their_encoding",
        "selftest says what is missing": "cli/test_selftest_says_what_works_and_what_to_do.py::"
        "test_without_a_compiler_the_line_to_type_is_said",
    },
    "Notebooks": {
        "twelve lines, HTML, tables": f"{SHOWN}::test_twelve_lines_html_and_a_table",
        "plots return axes": f"{SHOWN}::test_plots_give_axes_with_names",
        "plots of data, fit, residuals, horizon": f"{SHOWN}::test_plots_hold_the_numbers",
        "a slice of a GP": f"{SHOWN}::test_a_slice_of_a_gp_is_its_mean_and_two_deviations",
        "a frame of every table": f"{SHOWN}::test_a_frame_has_a_column_of_every_cell",
        "without pandas": f"{SHOWN}::test_without_pandas_one_line_names_the_extra",
        "literal types": "estimation/test_types_of_choices_are_the_names_that_there_are.py::"
        "test_a_literal_lists_the_registered_names",
        "dir is the API": f"{PUBLIC}::test_each_is_an_import_of_the_stub_and_can_be_had",
        "whatever comes back shows itself": f"{SHOWN}::test_whatever_a_public_function_gives_back_shows_itself",
        "at most twenty names": f"{PUBLIC}::test_there_are_at_most_twenty",
        "progress as a line": f"{TIME}::test_in_a_notebook_one_line_moves_and_says_how_it_ended",
    },
    "Pages": {
        "headline first": f"{BROWSER}::test_the_first_screen_is_the_headline",
        "settings last": f"{LEADS}::test_the_result_comes_first_and_the_settings_last",
        "figure and next step before all else": f"{LEADS}::"
        "test_every_page_has_its_result_its_figure_and_the_next_step_before_all_else",
        "rotation in degrees": f"{LEADS}::test_rotation_is_in_degrees_by_the_numbers",
        "bands and points zoom": f"{BROWSER}::test_a_bode_figure_zooms_with_its_band_and_its_points",
        "keyboard reaches everything": f"{BROWSER}::test_the_keyboard_reaches_every_link_fold_and_table_that_scrolls",
        "contrast": f"{BROWSER}::test_text_has_contrast_in_both_colour_schemes",
        "bar between prior and estimate": f"{LEADS}::test_a_bar_shows_the_estimate_inside_its_prior",
        "degrees": f"{LEADS}::test_attitude_is_roll_pitch_yaw_without_jumps",
        "at the floor": f"{LEADS}::test_more_than_all_of_a_gap_is_at_the_floor",
        "bars and t values": f"{LEADS}::test_every_estimate_with_a_spread_has_a_t",
        "zoom and linked axes": f"{BROWSER}::"
        "test_a_drag_zooms_all_figures_of_the_same_time_and_a_double_click_takes_it_back",
        "cursor and keys": f"{BROWSER}::test_the_cursor_tells_by_mouse_and_by_keyboard_what_the_curves_are_there",
        "ghost replay": f"{BROWSER}::test_the_ghost_is_where_the_model_said_and_its_distance_is_right",
        "Bode and coherence": "report/test_the_page_shows_how_outputs_follow_commands.py::"
        "test_the_pairs_are_those_of_frf_and_the_model_lies_over_them",
        "step response": "model/test_frequency_response_of_a_model_has_its_delays.py::"
        "test_the_step_response_is_the_frequency_response_in_time",
        "within a second": f"{BROWSER}::test_it_is_there_within_a_second",
        "no console error": f"{BROWSER}::test_the_console_stays_empty_and_nothing_is_fetched",
        "axe-core, while the controls are used": f"{BROWSER}::test_axe_finds_nothing_serious",
        "nothing cut off": f"{BROWSER}::test_no_table_of_the_page_is_cut_off_on_a_desk",
        "under 3 MB": f"{BROWSER}::test_it_is_under_three_megabytes_and_says_what_to_do_next",
        "prints, folds open": f"{BROWSER}::test_it_prints_to_paper",
    },
    "Recordings": {
        "of fit": f"{MCAP}::test_every_flight_has_its_poses_innovations_pushes_and_events",
        "of validate": f"{MCAP}::test_validate_writes_one_too_and_greybox_reads_its_own",
        "of mpc": "cli/test_mpc_flies_resumes_and_refuses.py::"
        "test_a_recording_has_every_watched_flight_with_its_plans_and_crossings",
        "Foxglove's schemas": "data/readers/test_protocol_buffers_are_read_and_written.py::"
        "test_types_are_those_that_foxglove_publishes",
        "Flight Review, read by pyulog": f"{MCAP}::"
        "test_flight_review_gets_attitude_rate_and_place_as_px4_would_log_them",
        "what PlotJuggler opens": f"{MCAP}::test_the_summary_tells_every_channel_and_its_type",
        "the band of force": f"{MCAP}::test_the_band_of_force_holds_its_value",
        "Rerun": f"{MCAP}::test_rerun_makes_transforms_and_texts_of_it",
        "a reader that is not ours": f"{MCAP}::test_another_reader_gets_the_same_numbers",
    },
    "Documentation": {
        "a bound on all words, pages short": f"{SHORT}::test_all_pages_together_are_a_short_book",
        "five pages": f"{SHORT}::test_the_learning_path_has_five_pages_and_each_leads_to_the_next",
        "40 words a sentence": f"{SHORT}::test_sentences_of_the_learning_path_are_short",
        "what to do with a bad fit is linked most": f"{SHORT}::"
        "test_no_page_is_linked_more_often_than_what_to_do_with_a_bad_fit",
        "figures stand by their command": f"{SHORT}::test_every_figure_stands_by_the_command_that_makes_it",
        "a site without a warning": "docs/test_the_site_builds_without_a_warning.py::"
        "test_the_site_builds_strictly_and_stands_alone",
        "no dead link": "docs/test_documentation_runs.py::test_every_link_leads_somewhere",
        "blocks run": "docs/test_documentation_runs.py::test_every_block_runs",
        "ten notebooks run": "docs/test_notebooks_run_and_show_figures.py::test_it_runs_and_draws",
        "reference is generated": "docs/test_the_reference_matches_the_code.py::test_the_pages_are_up_to_date",
        "rows have a proof": "docs/test_accuracy_names_tests_that_exist.py::test_every_row_of_a_table_has_its_proof",
    },
    "Words": {
        "one dialect of columns": f"{COLUMNS}::test_the_same_tables_in_either_file_give_the_same_channels",
        "the older form is read": f"{COLUMNS}::test_the_form_by_channel_is_read_says_so_once_and_is_printed_anew",
        "frames are asked for": "data/test_checks_judge_simulated_craft_too.py::"
        "test_an_accelerometer_that_points_down_asks_for_its_frame",
        "horizons in seconds": "docs/test_one_word_per_thing.py::test_no_other_word_is_used_for_the_same_thing",
        "sixty words": "docs/test_one_word_per_thing.py::test_there_are_at_most_sixty",
        "one word per thing": "docs/test_one_word_per_thing.py::test_no_other_word_is_used_for_the_same_thing",
        "the frame by gravity": "data/test_columns_are_guessed_and_never_used_unasked.py::"
        "test_units_in_names_count_before_sizes_and_a_negative_z_turns_the_frame",
    },
    "Progress": {
        "every long function": f"{TIME}::test_long_public_functions_show_a_line_and_keep_their_signatures",
        "no promise where nothing converges": f"{TIME}::test_a_solver_that_does_not_converge_promises_nothing",
        "nothing half written": "hardening/test_long_commands_stop_when_asked.py::test_nothing_half_written_is_left",
        "time left": f"{TIME}::test_the_share_gives_the_rest_at_the_pace_so_far",
        "Ctrl-C says what was kept": "hardening/test_long_commands_stop_when_asked.py::test_fit_keeps_the_best_values",
    },
    "Adoption": {
        "versions agree": f"{NAME}::test_every_file_that_states_a_version_states_this_one",
        "the paper cites what is there": f"{NAME}::test_every_work_that_the_paper_cites_is_in_its_bibliography",
        "the first effect runs": "docs/test_documentation_runs.py::test_every_block_runs",
        "a name that went works once more": f"{PUBLIC}::"
        "test_what_was_public_works_once_more_and_says_where_it_went",
        "files are valid": "docs/test_every_promise_to_its_users_has_a_test.py::test_files_for_adoption_are_valid",
    },
}
FILES = (
    "CITATION.cff",
    "codemeta.json",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "Dockerfile",
    "paper/paper.md",
    "recipe/meta.yaml",
    ".github/workflows/tests.yml",
    ".github/ISSUE_TEMPLATE/wrong_result.md",
    "LICENSE",
    "CHANGELOG.md",
)


@pytest.mark.parametrize("title", PROMISES)
def test_every_promise_has_a_test_that_is_there(title: str) -> None:
    for promise, where in PROMISES[title].items():
        file, _, name = where.partition("::")
        text = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {name or 'test_'}", text, re.MULTILINE), f"{promise}: {where}"
        body = text[text.index(f"def {name or 'test_'}") :]
        assert re.search(r"^    .*(assert|pytest\.raises|subprocess|run\()", body, re.MULTILINE), (
            promise
        )


@pytest.mark.parametrize("file", FILES)
def test_what_adoption_needs_is_there_and_says_something(file: str) -> None:
    assert len((ROOT / file).read_text(encoding="utf-8").split()) > 20


def test_files_for_adoption_are_valid() -> None:
    """They parse, and say what their readers ask of them."""
    yaml = pytest.importorskip("yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    about = json.loads((ROOT / "codemeta.json").read_text(encoding="utf-8"))
    assert (about["type"], about["identifier"]) == ("SoftwareSourceCode", project["name"])
    cite = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "version"} <= set(cite)
    _, head, paper = (ROOT / "paper/paper.md").read_text(encoding="utf-8").split("---\n", 2)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= set(
        yaml.safe_load(head)
    )
    titles = {line.strip("# ").lower() for line in paper.splitlines() if line.startswith("# ")}
    assert {"summary", "statement of need", "state of the field"} <= titles
    recipe = re.sub(r"{%.*%}\n", "", (ROOT / "recipe/meta.yaml").read_text(encoding="utf-8"))
    conda = yaml.safe_load(re.sub(r"{{ (\w+) }}", r"\1", recipe))
    names = {re.split(r"[ ><=]", r)[0].removesuffix("-base") for r in conda["requirements"]["run"]}
    assert names == {"python", *(re.split(r"[><=;\[ ]", d)[0] for d in project["dependencies"])}
    runs = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))
    systems = json.dumps(runs["jobs"])
    assert all(name in systems for name in ("ubuntu", "macos", "windows"))
    for form in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.md"):
        assert {"name", "about"} <= set(
            yaml.safe_load(form.read_text(encoding="utf-8").split("---")[1])
        )
    docker = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert re.search(r"^FROM python:3\.\d+", docker, re.MULTILINE)
    assert 'ENTRYPOINT ["greybox"]' in docker
    assert "Ten minutes to a first effect" in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
