"""The words of `--help` are those of the field, and printed defaults the real ones."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from attacks.cli import COMMANDS, main
from mi_splat.cli.flags import options_of

ROOT = Path(__file__).resolve().parents[2]
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
    r"\bjudges\b",
    r"\basked for\b",
    r"--(?:judge|picture|look|alone|in-turn)",
)
# the same in messages, reports and titles of tables
IN_MESSAGES = re.compile(
    r"\bpictures?\b(?!\.png)|\bscoreboard\b|\bjudges\b|\basked for\b|\bhangs? on\b"
    r"|\bin (?:the )?place of\b|\bgoes on with\b|\blooked at from\b|\bbeside it\b"
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


def literals(module: ast.Module) -> Iterator[str]:
    """The strings of a module that are sentences, without docstrings."""
    docstrings = {node.value for node in ast.walk(module) if isinstance(node, ast.Expr)}
    for node in ast.walk(module):
        if not isinstance(node, ast.Constant) or node in docstrings:
            continue
        if isinstance(node.value, str) and " " in node.value.strip():
            yield node.value


@pytest.mark.parametrize("package", ["mi_splat", "attacks"])
def test_messages_use_the_words_of_the_field(package: str) -> None:
    paths = sorted((ROOT / package).rglob("*.py"))
    found = [
        f"{path.relative_to(ROOT)}: {text}"
        for path in paths
        for text in literals(ast.parse(path.read_text()))
        if IN_MESSAGES.search(text)
    ]
    assert paths
    assert found == []


def test_the_test_of_messages_finds_a_word() -> None:
    module = ast.parse('"""A picture."""\nraise ValueError("two pictures")')
    (text,) = literals(module)
    assert IN_MESSAGES.search(text)


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
