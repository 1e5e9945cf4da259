"""The digest of the code that a piece of work runs: what changes it, what does not, and
that nothing is forgotten.
"""

from importlib.metadata import version
from pathlib import Path

import pytest

from mi_splat import import_closure
from mi_splat.import_closure import closure, code_digest

ENTRY = '''"""Says something."""
import math
from toy import LAZY
from toy.helper import double


def run(number: int) -> int:
    """Doubles."""
    if number < 0:
        raise ValueError("a number below 0")
    if number > 2:
        from toy import late
        return late.LIMIT
    return double(number)  # twice
'''
FILES = {
    "__init__.py": '_NAMES = {"toy.lazy": ("LAZY", "OTHER")}\n',
    "entry.py": ENTRY,
    "helper.py": "def double(number: int) -> int:\n    return 2 * number\n",
    "late.py": "LIMIT = 4\n",
    "lazy.py": "LAZY = 1\n",
    "named.py": 'TABLE = {"late": "toy.late"}\n',
    "other.py": "UNUSED = 1\n",
}


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package whose module `entry` imports some of the others."""
    for name, text in FILES.items():
        (tmp_path / "toy").mkdir(exist_ok=True)
        (tmp_path / "toy" / name).write_text(text)
    monkeypatch.setattr(import_closure, "ROOT", tmp_path)
    forget()
    return tmp_path / "toy"


def forget() -> None:
    for function in vars(import_closure).values():
        if hasattr(function, "cache_clear"):
            function.cache_clear()


@pytest.fixture(autouse=True)
def _forgotten() -> object:
    yield
    forget()


def test_all_that_is_imported_belongs_to_it(toy: Path) -> None:
    assert closure("toy.entry") == (
        "toy",
        "toy.entry",
        "toy.helper",
        "toy.late",
        "toy.lazy",
    )
    # loaded by its name
    assert closure("toy.named") == ("toy", "toy.late", "toy.named")


@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("entry.py", "number > 2", "number > 3", True),
        ("helper.py", "2 * number", "number * 2", True),
        ("late.py", "4", "5", True),
        ("lazy.py", "1", "2", True),
        ("other.py", "1", "2", False),
        ("entry.py", "Doubles.", "Multiplies by two.", False),
        ("entry.py", "Says something.", "Says nothing.", False),
        ("entry.py", "  # twice", "", False),
        ("entry.py", "number: int", "number: float", False),
        ("helper.py", "-> int", "-> float", False),
        ("entry.py", "a number below 0", "a positive number", False),
    ],
)
def test_what_changes_the_digest(
    file: str, old: str, new: str, changes: bool, toy: Path
) -> None:
    before = code_digest("toy.entry")
    text = (toy / file).read_text()
    assert old in text
    (toy / file).write_text(text.replace(old, new))
    forget()
    assert (code_digest("toy.entry") != before) is changes


def test_a_module_that_is_moved_is_the_same_code(toy: Path) -> None:
    before = code_digest("toy.entry")
    (toy / "helper.py").rename(toy / "doubling.py")
    (toy / "entry.py").write_text(ENTRY.replace("toy.helper", "toy.doubling"))
    forget()
    assert code_digest("toy.entry") == before


def test_what_is_loaded_by_a_whole_name_in_a_table_is_followed() -> None:
    assert {"mi_splat.io.formats.spz", "mi_splat.io.formats.sog"} <= set(
        closure("mi_splat.io.splat_files")
    )
    assert "attacks.cloak.layers" not in closure("mi_splat.io.splat_files")


@pytest.mark.parametrize("packages", [("numpy", "0.0"), ("torch", "0.0")])
def test_versions_of_other_packages_belong_to_it(
    packages: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = code_digest("mi_splat.scene")
    name, other = packages
    monkeypatch.setattr(
        "importlib.metadata.version",
        lambda asked: other if asked == name else version(asked),
    )
    code_digest.cache_clear()
    assert code_digest("mi_splat.scene") != before
