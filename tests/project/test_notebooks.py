"""The notebooks of the site: their form. `make docs` runs them, and a cell that fails ends it."""

import ast
import itertools
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.project.layers import ROOT

FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.md"))
LONGEST = 12
"""Lines of a cell at most."""


def cells(name: str) -> list[str]:
    text = (FOLDER / f"{name}.md").read_text()
    return re.findall(r"^```\{code-cell\} ipython3\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def test_there_are_seven_and_all_are_in_the_tree_in_their_order() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    listed = re.findall(r"^notebooks/(.+)$", index, flags=re.MULTILINE)
    assert sorted(listed) == NOTEBOOKS
    assert len(listed) == 7
    for name, following in itertools.pairwise(listed):
        assert re.search(rf"^Next: \[[^\]]+\]\({following}\.md\)\.$", (FOLDER / f"{name}.md").read_text(), re.MULTILINE)


def shows(cell: str) -> bool:
    """Whether a cell ends in a value that a notebook shows."""
    last = ast.parse(cell).body[-1]
    return isinstance(last, ast.Expr) and not ast.unparse(last).startswith(("print(", "check_"))


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_has_short_cells_pictures_and_a_conclusion(name: str) -> None:
    text, code = (FOLDER / f"{name}.md").read_text(), cells(name)
    assert text.count("```{code-cell}") == len(code) >= 5
    assert re.search(r"^# .+\n\nYou will see .+\.$", text, flags=re.MULTILINE)
    assert f"{{nb-download}}`Download this notebook <{name}.ipynb>`" in text
    assert text.count("**What to conclude.**") == 1
    assert max(len(cell.strip().splitlines()) for cell in code) <= LONGEST
    assert sum(map(shows, code)) >= 3, "pictures say more"


def test_every_kind_of_plug_in_is_tried_in_a_cell() -> None:
    from attacks import testing

    tried = set(re.findall(r"\bcheck_\w+(?=\()", "\n".join(cell for name in NOTEBOOKS for cell in cells(name))))
    assert tried == {name for name in testing.__all__ if name.startswith("check_")}


@pytest.mark.nightly
def test_a_cell_that_fails_ends_the_build(tmp_path: Path) -> None:
    pytest.importorskip("myst_nb", reason="notebooks need the extra docs")
    conf, makefile = ((ROOT / name).read_text() for name in ("docs/conf.py", "Makefile"))
    assert "sphinx -b html -W --keep-going" in makefile
    settings = re.findall(r"^nb_.*$", conf, flags=re.MULTILINE)
    (tmp_path / "conf.py").write_text("\n".join(["import os", 'extensions = ["myst_nb"]', *settings]))
    head = (FOLDER / "first-attack.md").read_text().split("# First")[0]
    (tmp_path / "index.md").write_text(f"{head}# A\n\n```{{code-cell}} ipython3\nprint(1 / 0)\n```\n")
    words = ["-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q", str(tmp_path), str(tmp_path / "out")]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode != 0
    assert "ZeroDivisionError" in done.stderr
