"""The kinds of results that can be artifacts: one line each."""

from __future__ import annotations

from pathlib import Path

from attacks.artifacts import cloak, dagger, dagger_eot
from attacks.artifacts.contents import read_object
from attacks.artifacts.packed import Kind
from attacks.artifacts.studies import dagger_studies, transfer
from attacks.cloak.study.run import SUMMARY
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import RECORD as RESULT

KINDS: dict[str, Kind] = {
    "cloak": cloak.KIND,
    "dagger-eot": dagger_eot.KIND,
    "dagger": dagger.KIND,
    "dagger-eot-study": dagger_studies.EOT_STUDY,
    "dagger-study": dagger_studies.STUDY,
    "dagger-pairs": dagger_studies.PAIRS_STUDY,
    transfer.TRANSFER: transfer.TRANSFER_KIND,
    transfer.OVER_VIEWS: transfer.VIEWS_KIND,
}
"""By the command that makes the result."""


def kind_of(folder: Path) -> str:
    """The kind of the result in a folder.

    Raises:
        InvalidValueError: It holds none that can be an artifact.
    """
    name = _of_study(folder)
    if name is None and (folder / SUMMARY).is_file():
        name = "dagger-pairs" if "pairs" in read_object(folder / SUMMARY) else "cloak"
    elif name is None and (folder / RESULT).is_file():
        name = str(read_object(folder / RESULT).get("attack"))
    if name not in KINDS:
        expected = f"a finished result of mi-splat {', '.join(KINDS)}"
        got = "none" if name is None else f"one of {name[:40]}"
        raise InvalidValueError(message(str(folder), expected, got, "pass the folder that the command has written"))
    return name


def _of_study(folder: Path) -> str | None:
    """The kind of a study of DAGGER that is known by a file of its own; None if there is none."""
    if (folder / "transfer.json").is_file():
        return transfer.TRANSFER
    if (folder / "held_out.json").is_file():
        return transfer.OVER_VIEWS
    if not (folder / dagger_studies.TABLE).is_file():
        return None
    return "dagger-eot-study" if "smallest" in read_object(folder / dagger_studies.TABLE) else "dagger-study"


def known_kind(name: str, where: Path) -> Kind:
    """The kind that an artifact names.

    Raises:
        InvalidValueError: There is none of this name.
    """
    if name not in KINDS:
        do = "read it with the version of mi-splat that wrote it"
        raise InvalidValueError(message(str(where), f"a kind of {', '.join(KINDS)}", name[:40], do))
    return KINDS[name]
