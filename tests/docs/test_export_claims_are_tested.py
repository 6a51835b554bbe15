"""What README and docs claim of exports and consumers is in a table of tests; a new claim without a
test fails here."""

from __future__ import annotations

import re

import pytest

from greybox.commands import export as command
from tests.docs.pages import ROOT

README = (ROOT / "README.md").read_text()
BUNDLE = (ROOT / "docs" / "bundle.md").read_text()
GPYTORCH = (ROOT / "docs" / "gpytorch.md").read_text()
EVERY = "tests/mpc_export/test_every_fitted_thing_exports.py"
IDENTIFIED = "tests/mpc_export/test_bundles_compute_in_c_what_casadi_does.py"
OVER = "tests/residual/test_gpytorch_models_come_over_whole.py"
VERIFIES = f"{EVERY}::test_its_bundle_passes_the_verifier"

CLAIMS = {
    "physics": f"{IDENTIFIED}::test_some_effects_alone_in_double",
    "hybrid": f"{IDENTIFIED}::test_a_hybrid_in_double",
    "linear": f"{IDENTIFIED}::test_single_precision",
    "output hybrid": VERIFIES,
    "NARX": VERIFIES,
    "LSTM": VERIFIES,
    "GP": VERIFIES,
    "C without malloc": VERIFIES,
    "CasADi rebuilt from numbers": "tests/mpc_export/test_rebuild_gives_the_same_functions.py",
    "golden vectors": "tests/mpc_export/test_bundles_are_whole_and_stand_alone.py",
    "a verifier": VERIFIES,
    "GPyTorch": f"{OVER}::test_every_kernel_of_an_exact_model_is_gpytorchs_own",
    "BoTorch": f"{OVER}::test_botorchs_single_task_gp_comes_over",
    "acados": "tests/mpc_export/test_acados_solves_the_exported_model.py",
    "do-mpc": "tests/mpc_export/test_do_mpc_closes_the_loop.py",
    "rockit": "tests/mpc_export/test_rockit_solves_the_exported_model.py",
    "l4acados": "tests/mpc_export/test_l4acados_residual_needs_no_torch.py",
    "FMI": "tests/mpc_export/test_fmu_is_f.py",
}
"""What README's lines on export and consumers claim, word by word, and the test of it."""


def bullet(title: str) -> str:
    """One point of README's list, on one line."""
    found = re.search(
        rf"^- \*\*{title}\*\*: (.*?)(?=^- \*\*|^```|^$)", README, re.DOTALL | re.MULTILINE
    )
    assert found, title
    return " ".join(found[1].split())


def there(test: str) -> bool:
    file, _, name = test.partition("::")
    path = ROOT / file
    return path.exists() and (not name or f"def {name}(" in path.read_text())


def test_every_claimed_word_has_a_test_that_exists():
    assert [t for t in CLAIMS.values() if not there(t)] == []


def test_readme_claims_nothing_of_export_that_the_table_does_not_hold():
    export, consumers = bullet("Export"), bullet("Consumers")
    kinds = re.search(r"\((physics[^)]*)\)", export)
    assert kinds
    named = [k.strip() for k in kinds[1].split(",")]
    named += [p.strip() for p in re.split(r", | and ", export.split(") as ")[1].split(":")[0])]
    named += re.split(r" or ", re.search(r"\[([^\]]*)\]\(docs/gpytorch.md\)", export)[1])  # type: ignore[index]
    tools = consumers.split("runs with ")[1].split(" tools")[0]
    named += re.split(r", | and ", tools)
    assert sorted(named) == sorted(CLAIMS)


def test_the_command_offers_what_the_writers_can_do():
    from mpc_export.functions import GROUPS
    from mpc_export.options import TARGETS

    assert set(command.TARGETS) == set(TARGETS)
    assert set(command.GROUPS) == set(GROUPS)


def test_every_kind_of_fitted_thing_in_the_table_of_export_is_a_case_of_the_tests():
    from tests.mpc_export.predictor_cases import ALONE, PREDICTORS

    cases = " ".join({**PREDICTORS, **ALONE})
    rows = re.findall(
        r"^\| (.*?) \| ", BUNDLE.split("| what is fitted |")[1].split("\n\n")[0], re.MULTILINE
    )
    words = {
        "output hybrid": "output hybrid",
        "linear": "linear",
        "NARX": "NARX",
        "LSTM": "LSTM",
        "a GP alone": "GP alone",
    }
    identified = [r for r in rows if "physics" in r or set(r) <= set("-| ")]
    for row in (r for r in rows if r not in identified):
        said = [w for w in words if row.startswith(w) or f", {w}" in row]
        assert said, f"no case for: {row}"
        assert all(words[w] in cases for w in said)


def test_the_functions_in_the_table_are_functions_of_some_case():
    from mpc_export.functions import GROUPS, model_functions
    from tests.mpc_export import cases
    from tests.mpc_export.predictor_cases import PREDICTORS

    table = BUNDLE.split("## Functions")[1].split("\n\n")[1]
    named = {n for row in table.splitlines() for n in re.findall(r"`(\w+)`", row.split("|")[1])}
    models = [cases.hybrid(), PREDICTORS["output hybrid, SISO"](), PREDICTORS["LSTM"]()]
    made: set[str] = set()
    for model in models:
        groups, runtime = (
            (GROUPS, ("gp.weights",)) if model is models[0] else (("covariance", "filter"), ())
        )
        made |= set(model_functions(model, with_=groups, runtime_parameters=runtime).functions)
    assert sorted(named - made) == []


def test_every_gpytorch_class_that_the_page_names_is_read_in_a_test():
    pytest.importorskip("gpytorch")
    text = (ROOT / "tests" / "residual" / "gpytorch_cases.py").read_text()
    text += (ROOT / OVER).read_text()
    table = GPYTORCH.split("| what | read |")[1].split("\n\n")[0]
    named = set(re.findall(r"`([A-Z]\w+)`", table))
    assert len(named) > 15
    assert sorted(n for n in named if n not in text) == []
