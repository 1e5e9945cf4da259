"""The notebooks of the site: their form.

`make docs` runs them, and a cell that fails ends it.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.project.layers import ROOT

FOLDER = ROOT / "docs" / "notebooks"


@pytest.mark.nightly
def test_a_cell_that_fails_ends_the_build(tmp_path: Path) -> None:
    pytest.importorskip("myst_nb", reason="notebooks need the extra docs")
    conf, makefile = (
        (ROOT / name).read_text() for name in ("docs/conf.py", "Makefile")
    )
    assert "sphinx -b html -W --keep-going" in makefile
    settings = re.findall(r"^nb_.*$", conf, flags=re.MULTILINE)
    (tmp_path / "conf.py").write_text(
        "\n".join(["import os", 'extensions = ["myst_nb"]', *settings])
    )
    head = (FOLDER / "first-attack.md").read_text().split("# First")[0]
    (tmp_path / "index.md").write_text(
        f"{head}# A\n\n```{{code-cell}} ipython3\nprint(1 / 0)\n```\n"
    )
    words = [
        "-m",
        "sphinx",
        "-b",
        "html",
        "-W",
        "--keep-going",
        "-q",
        str(tmp_path),
        str(tmp_path / "out"),
    ]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode != 0
    assert "ZeroDivisionError" in done.stderr
