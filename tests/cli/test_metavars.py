"""Values of options are called by what they mean."""

from __future__ import annotations

import pytest

from attacks import cli
from attacks.cli.metavars import KINDS, METAVARS, metavar
from attacks.cli.parsing import argument_parser


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_no_value_is_called_by_its_type(command: str) -> None:
    for action in argument_parser(command, cli.COMMANDS[command])._actions:
        words = str(action.metavar or "").strip("[]").split()
        assert not set(words) & {"FLOAT", "INT", "STR"}, action.option_strings
        assert action.metavar or action.nargs == 0, action.option_strings


def test_there_is_a_word_for_each_value() -> None:
    assert metavar("CameraOptions", "centre", "FLOAT FLOAT FLOAT") == "X Y Z"
    assert metavar("CloakOptions", "seeds", "[INT ...]") == "[SEED ...]"
    assert metavar("DaggerSanityOptions", "seeds", "INT") == "COUNT"
    assert metavar("AnyOptions", "unheard_of", "FLOAT") == "NUMBER"


def test_the_table_holds_options_that_there_are() -> None:
    actions = [a for name, command in cli.COMMANDS.items() for a in argument_parser(name, command)._actions]
    known = {action.dest.rpartition(".")[2].replace("-", "_") for action in actions}
    of_strategies = {"growth", "dead_opacity", "noise_lr", "opacity_reg", "scale_reg"}  # shown with --strategy mcmc
    assert {key.rpartition(".")[2] for key in METAVARS} <= known | of_strategies
    assert not set(KINDS.values()) & set(KINDS)


def test_what_may_be_left_out_stands_in_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    for command, shown in (("dagger", "[FILE]"), ("info", "FILE"), ("train", "classic|mcmc|fixed")):
        assert cli.main([command, "--help"]) == 0
        assert shown in capsys.readouterr().out
