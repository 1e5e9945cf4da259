"""Stages of a study that are done once: each has a folder that is named by everything that it depends on.

A stage whose folder is complete is not done again, whichever study asks for it; one that was interrupted goes on where
it stopped. What a stage made is known by its content, so that equal pictures lead to the same splat wherever they come
from.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.errors import InvalidValueError, message
from mi_splat.import_closure import code_digest
from mi_splat.io.atomic import is_temporary, sweep_temporary
from mi_splat.io.documents import save_json
from mi_splat.io.fields import Fields
from mi_splat.io.locks import locked_folder
from mi_splat.io.parsing import read_json

DONE = "done.json"

# Not written as whole names: who imports this module would be taken to load all of them (`mi_splat.import_closure`).
_ATTACKS, _LIBRARY = "attacks", "mi_splat"
_CLOAK = f"{_ATTACKS}.cloak"
_STUDY = f"{_CLOAK}.study"
_PICTURES = (f"{_CLOAK}.setup", f"{_STUDY}.kept_pictures")
_SPLAT = tuple(
    f"{_LIBRARY}.{name}" for name in ("training.resume", "training.initialization", "datasets.dataset", "rendering")
)
_DETECTORS = f"{_ATTACKS}.detectors.registry"
STAGE_CODE: dict[str, tuple[str, ...]] = {
    "pictures": (f"{_CLOAK}.setup", f"{_LIBRARY}.capture.writer"),
    "appearance": _PICTURES,
    "true_pictures": _PICTURES,
    "poisoned": (*_PICTURES, f"{_CLOAK}.poisoning", f"{_LIBRARY}.datasets.writing", f"{_LIBRARY}.rendering"),
    "splat": (f"{_CLOAK}.setup", f"{_STUDY}.trained_splats", *_SPLAT),
    "layers": (f"{_CLOAK}.setup", f"{_CLOAK}.layers", *_SPLAT),
    "cleaned": (f"{_STUDY}.trained_splats",),
    "observations": (f"{_CLOAK}.observations", _DETECTORS),
    "view_reports": (f"{_CLOAK}.experiments.view_reports", _DETECTORS),
}
"""Modules whose code makes each stage, with all that they import (`mi_splat.import_closure`).

`attacks.cloak.study.pipeline`, which calls them, counts without its imports: it has those of all stages.
"""
_CALLER = f"{_STUDY}.pipeline"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A finished stage.

    Attributes:
        folder: Where it is.
        content: SHA-256 of the files that later stages read.
        commit: Of the checkout that made it, which may be an earlier one than today's; None if unknown.
    """

    folder: Path
    content: str
    commit: str | None


class StageCache:
    """A folder of stages; several studies may share it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def folder(self, name: str, depends_on: Mapping[str, Any]) -> Path:
        """The folder of a stage, whether or not it is there; the arguments are those of `finished`."""
        return self._folder / f"{name}-{digest(_dependencies(name, depends_on))}"

    def finished(
        self,
        name: str,
        depends_on: Mapping[str, Any],
        make: Callable[[Path], None],
        *,
        outputs: Iterable[str] = ("**/*",),
    ) -> Stage:
        """A stage, which is done now if it is not there.

        Args:
            name: One of `STAGE_CODE`.
            depends_on: Everything that the stage depends on besides its code, as JSON can hold it; inputs that other
                stages made by their content.
            make: Does it, in the folder, and goes on with what an interrupted call left.
            outputs: Patterns of the files that later stages read.

        Raises:
            SplatFileError: Another process does this stage now.
            InvalidValueError: The stage is there, and a file of it is not what it wrote.
        """
        path = self.folder(name, depends_on)
        if not (path / DONE).is_file():
            with locked_folder(path):
                if not (path / DONE).is_file():  # nobody has done it while this process came to the lock
                    sweep_temporary(path)
                    make(path)
                    made_by = {"commit": provenance.commit(), "versions": provenance.versions()}
                    content = content_of(path, outputs)
                    save_json({**_dependencies(name, depends_on), "content": content, "made_by": made_by}, path / DONE)
        do = "delete its folder, so that it is made again"
        done = Fields(read_json(path / DONE), str(path / DONE), InvalidValueError, do)
        commit, content = done.object("made_by").values.get("commit"), done.text("content")
        if content_of(path, outputs) != content:
            raise InvalidValueError(message(f"stage {path}", "the files that it wrote", "others", do))
        return Stage(folder=path, content=content, commit=None if commit is None else str(commit))


def digest(values: Mapping[str, Any]) -> str:
    """16 digits that stand for some values, as JSON writes them."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def content_of(folder: Path, patterns: Iterable[str]) -> str:
    """SHA-256 of the names and bytes of the files in a folder that fit one of the patterns."""
    total = hashlib.sha256()
    for path in sorted({path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}):
        if path.name != DONE and not is_temporary(path.name):
            total.update(f"{path.relative_to(folder).as_posix()} {path.stat().st_size}\n".encode())
            total.update(path.read_bytes())
    return total.hexdigest()


def _dependencies(name: str, depends_on: Mapping[str, Any]) -> dict[str, Any]:
    code = code_digest(*STAGE_CODE[name], alone=(_CALLER,))
    return {"stage": name, "code": code, "depends_on": dict(depends_on)}
