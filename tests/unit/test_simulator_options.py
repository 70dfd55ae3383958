"""What values the options of `simulate` and `demo` take."""

import argparse

import pytest

from bridged import cli
from bridged.simulators.options import matching


def test_arguments_that_are_no_numbers(capsys: pytest.CaptureFixture[str]):
    for arguments, text in (
        (["demo", "--duration", "abc"], "argument --duration: expected a number above 0, got 'abc'"),
        (["demo", "--rate", "-1"], "argument --rate: expected a number above 0, got '-1'"),
        (["simulate", "can232", "--count", "1.5"], "--count: expected a whole number above 0, got '1.5'"),
        (["simulate", "can232", "--count", "0"], "--count: expected a whole number above 0, got '0'"),
    ):
        with pytest.raises(SystemExit):
            cli.main(arguments)
        assert text in capsys.readouterr().err


def test_a_text_that_does_not_match() -> None:
    check = matching("A+", "a row of A")
    assert check("AAA") == "AAA"
    with pytest.raises(argparse.ArgumentTypeError, match="'AB' is not a row of A"):
        check("AB")
