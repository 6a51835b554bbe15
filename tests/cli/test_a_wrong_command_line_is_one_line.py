"""What a command line lacks or has too much is said in one line, by the command that was meant, with
the option that was."""

from __future__ import annotations

import pytest

from greybox.cli import main


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("plan model.json", "greybox plan: no option says what model.json is. Usual fix: --model"),
        ("plan v.toml", "Usual fix: --vehicle v.toml"),
        (
            "fit --train a.csv --tst b.csv",
            "greybox fit: unknown option '--tst'. Usual fix: did you",
        ),
        (
            "fit --vehicle v.toml a.csv",
            "greybox fit: the following arguments are required: --train",
        ),
        (
            "plan --quiet",
            "greybox plan: --quiet stands before the command. Usual fix: greybox --qu",
        ),
        ("plan --rate fast", "greybox plan: argument --rate: invalid float value: 'fast'"),
        ("vehicle new x", "greybox vehicle new: no option says what x is"),
        ("vehicle", "greybox vehicle: the following arguments are required: new|check"),
        ("fitt", "greybox: unknown command 'fitt'. Usual fix: did you mean fit"),
        ("completion fishh", "greybox completion: unknown shell 'fishh'. Usual fix: did you mean"),
        (
            "fit --train a.csv --input spee",
            "unknown value of --input 'spee'. Usual fix: did you mean speed",
        ),
        ("fit --vehicle v --train b -- a.csv", "Usual fix: --train a.csv, --test a.csv"),
    ],
)
def test_it_is_one_line(typed, said, capsys):
    with pytest.raises(SystemExit) as end:
        main(typed.split())
    out, err = capsys.readouterr()
    assert end.value.code == 2
    assert out == "" and err.count("\n") == 1
    assert said in err and "Usual fix: " in err


def test_a_log_is_offered_to_the_options_that_take_logs(capsys):
    with pytest.raises(SystemExit):
        main(
            [
                "frf",
                "--train",
                "a.csv",
                "--inputs",
                "u1",
                "--outputs",
                "p",
                "--rate",
                "100",
                "b.csv",
            ]
        )
    assert "--train b.csv" in capsys.readouterr().err
