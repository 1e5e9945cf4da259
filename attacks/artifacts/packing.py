"""Packing a finished result into the folder of an artifact."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from attacks.artifacts.contents import CAMERAS, RECORD, SPLATS, Contents, checked_page, record_of
from attacks.artifacts.figures import compared, flat
from attacks.artifacts.kinds import KINDS, kind_of
from attacks.artifacts.packed import OnView, Packed
from attacks.artifacts.rows import read_table, write_table
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import new_folder


def pack_artifact(
    result: Path,
    out: Path,
    *,
    stages: Path | None = None,
    pages: Sequence[str] = (),
    splats: bool = False,
    force: bool = False,
    detectors: Sequence[Detector] = (),
    on_view: OnView = lambda done, total: None,
) -> Contents:
    """Pack a finished result into a new folder, which appears whole or not at all.

    The rows are read back from the files that were written, and have to give every figure that the result states.

    Args:
        result: Folder of a finished result, of one of the kinds in `attacks.artifacts.kinds.KINDS`.
        out: The new folder.
        stages: Folder of a study's stages; None is one in `result`.
        pages: Pages of the documentation that show its figures, relative to the checkout.
        splats: Whether to pack the splats, too.
        force: Whether an older artifact at `out` may be replaced.
        detectors: Those of a study, to look at its splats again and keep every detection; none keeps what the study
            has kept, which is the highest scores on the object.
        on_view: Told how many pictures they have looked at.

    Returns:
        What the artifact holds.

    Raises:
        InvalidValueError: There is no finished result, or its rows do not give its figures.
        SplatFileError: `out` is in use or cannot be written.
    """
    named = tuple(checked_page(page, "page") for page in pages)
    kind = KINDS[kind_of(result)]
    packed = kind.pack(result, stages)
    contents = replace(packed.contents, pages=named)
    if detectors:
        if kind.look is None:
            do = "leave --detections out"
            raise InvalidValueError(message(str(result), "a study of CLOAK, for detections", contents.kind, do))
        contents = replace(contents, tables={**contents.tables, **kind.look(packed, detectors, on_view)})
    with new_folder(out, force=force, record=RECORD) as folder:
        written = {name: write_table(table, folder, name) for name, table in contents.tables.items()}
        columns = kind.columns(contents)
        tables = {name: read_table(path, columns[name]) for name, path in written.items()}
        expected = tuple(flat(packed.figures))
        reread = replace(contents, tables=tables)
        lines = [*compared(expected, tuple(flat(kind.derive(reread)))), *kind.agree(reread)]
        off = next((line for line in lines if not line.passed), None)
        if off is not None:
            got, do = f"{off.name}: {off.words}", "make the result again: it is not of these observations"
            raise InvalidValueError(message(str(result), "the figures that its rows give", got, do))
        contents = replace(contents, figures=expected)
        if packed.cameras is not None:
            save_json(packed.cameras, folder / CAMERAS, indent=0)
        for name, text in packed.texts.items():
            save_text(text, folder / name)
        for name, source in packed.files.items():
            shutil.copyfile(source, folder / name)
        if splats:
            _copy_splats(packed, folder)
        save_json(record_of(contents, folder), folder / RECORD)
    return contents


def _copy_splats(packed: Packed, folder: Path) -> None:
    """Copy every splat of the result."""
    (folder / SPLATS).mkdir()
    if not packed.splats:
        raise InvalidValueError(message("splats", "splats in the result", "none", "leave --splats out"))
    for name, source in packed.splats.items():
        if source is None or not source.is_file():
            do = "pass the folder of stages, or leave --splats out"
            raise InvalidValueError(message(name, "the splat's file", "none", do)).hinted("--stages")
        shutil.copyfile(source, folder / name)
