"""Links, style and spelling of the pages, which `make lint` checks, and that the checker sees what it shall."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.project import prose
from tests.project.documented_commands import ROOT

STYLE = prose.Style(words=8, figures=1, site=40, forbidden={"canopy": "occluder"})


def test_pages_keep_links_and_style() -> None:
    """What fails here is made shorter, or linked right; what became better: python -m tests.project.prose --shrink."""
    assert prose.check() == []


def test_pages_are_spelled_right() -> None:
    pytest.importorskip("codespell_lib", reason="spelling is checked by codespell, of the extra dev")
    done = subprocess.run([sys.executable, "-m", "codespell_lib"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Short. One two three four five six seven eight nine.", (1, 0)),
        ("- An item of five words\n- and one more of six words", (0, 0)),
        ("Found by 3 of 4, and by 5.", (0, 1)),
        ("From 95.1 % and 96.0 % of them. Seed 0, Mitsuba 3: 1 to 2 degrees. On 2026-11-24 1 was.", (0, 0)),
        ("| a table has 1 | 2 | 3 figures and as many words as it wants |", (0, 0)),
        ("```sh\nas many words as it wants, and 1 2 3 4 5 6 7 8 9\n```", (0, 0)),
        ("[One word](a.md) for `a b c d e f g h i j 1 2 3`", (0, 0)),
        (":::{figure} a.png\nThis caption of 3 pictures and 4 tables is counted.\n:::", (1, 1)),
    ],
)
def test_what_is_counted(text: str, expected: tuple[int, int]) -> None:
    assert prose.measured(text).too_much(STYLE) == expected


def test_complaints_name_the_worst_sentence_and_what_to_do() -> None:
    text = "The canopy has 3 leaves, 4 branches and a root that nobody sees."
    assert prose.complaints("page.md", "Fine.", STYLE) == []
    first, shown, second, _, word = prose.complaints("page.md", text, STYLE)
    assert first.startswith("page.md: 1 sentences of more than 8 words")
    assert shown == f"    13: {text}"
    assert second.startswith("page.md: 1 sentences of more than 1 figures")
    assert word.endswith("write occluder")
    allowed = prose.complaints("page.md", text, STYLE, (1, 1))
    assert [line for line in allowed if "canopy" not in line] == []
    (shrink,) = prose.complaints("page.md", "Fine.", STYLE, (1, 0))
    assert "--shrink" in shrink


def test_dead_links(tmp_path: Path) -> None:
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    other.write_text("# A title\n\n## Two words, `code`\n\n```text\n# none\n```\n")
    good = "[a](other.md) [b](other.md#two-words-code) [c](https://a.example/) [d](#here) ![e](other.md)\n\n# Here\n"
    assert prose.dead_links(page, good, written=()) == []
    bad = "[a](none.md) [b](other.md#none) [c](http://a.example/) [d](#there) ![e](none.png)"
    dead = ["none.md", "other.md#none", "http://a.example/", "#there", "none.png"]
    assert prose.dead_links(page, bad, written=()) == dead


def test_what_is_allowed_falls_and_does_not_rise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "style.toml"
    limits = prose.STYLE.read_text().partition("[allowed]\n")[0]
    copy.write_text(f'{limits}[allowed]\n"docs/a.md" = [5, 0]\n"docs/b.md" = [0, 2]\n"docs/gone.md" = [1, 1]\n')
    monkeypatch.setattr(prose, "STYLE", copy)
    (tmp_path / "a.md").write_text("Word " * 26 + ".")
    (tmp_path / "b.md").write_text("Short, 1, 2. " * 3)
    monkeypatch.setattr(prose, "by_hand", lambda: {f"docs/{name}.md": tmp_path / f"{name}.md" for name in "ab"})
    prose.shrink()
    fallen = re.sub(r"site = \d+", "site = 1000", limits)
    assert copy.read_text() == f'{fallen}[allowed]\n"docs/a.md" = [1, 0]\n"docs/b.md" = [0, 2]\n'


def test_the_site_cannot_grow_unseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables and code count, their bars do not."""
    (tmp_path / "a.md").write_text("Three words here.\n\n| in a | table |\n|---|---|\n\n```sh\ncode --flag 3\n```\n")
    monkeypatch.setattr(prose, "by_hand", lambda: {"docs/a.md": tmp_path / "a.md"})
    assert prose.words_of_site() == 3 + 3 + 1 + 3
    for most, complained in ((10, 0), (9, 1)):
        style = replace(prose.read_style()[0], site=most)
        monkeypatch.setattr(prose, "read_style", lambda style=style: (style, {}))
        monkeypatch.setattr(prose, "pages", list)
        assert len(prose.check()) == complained


def test_the_figures_of_style_have_a_line_for_every_page() -> None:
    lines = list(prose.figures())
    assert len(lines) == len(prose.by_hand()) + 3
    assert lines[-2].endswith("all pages")
    assert f"allows {prose.read_style()[0].site}" in lines[-1]
