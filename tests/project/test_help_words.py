"""The words of `--help` are those of the field, and printed defaults the real ones."""

import re
from dataclasses import dataclass

import pytest

from attacks.cli import COMMANDS, main
from mi_splat.cli.flags import options_of

# words that no sense of is right in help: others say the same as the field does
BANNED = (
    r"(?<![-{,.:])\bpictures?\b(?!\.png| options| NUMBER| COUNT)",
    r"\bNone (?:is|takes|sets|keeps|asks)\b",
    r"\(default: none\)",
    r"\blooked at from\b",
    r"\bshall see\b",
    r"\bgoes on (?:where|when|with)\b",
    r"\bin the place of\b",
    r"\bso many\b",
    r"\bscoreboard\b",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_uses_the_words_of_the_field(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command.split(), "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    # where "none" is a choice, it is a real default
    text = re.sub(r"\{[\w,]*\bnone\} [^{}]*?\(default: none\)", "", text)
    found = [word for word in BANNED if re.search(word, text)]
    assert found == []


@dataclass(frozen=True)
class _Options:
    near: float | None = None
    """Near plane. Default: that of the scene."""
    out: str | None = None
    """Folder."""
    early: bool = True
    """Whether it may stop early. --no-early: take every step."""


def test_help_states_real_defaults_and_what_a_flag_turns_off() -> None:
    texts = {option.name: option.help for option in options_of(_Options)}
    assert texts == {
        "near": "Near plane. (default: that of the scene)",
        "out": "Folder.",
        "early": "Take every step.",
    }
