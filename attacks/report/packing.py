"""Packing a finished result for others: its files as they are, without what is large unless that is asked for."""

from __future__ import annotations

import shutil
from pathlib import Path

from attacks.report.checking import (
    KEPT,
    Check,
    Figures,
    Result,
    check_detections,
    check_figures,
    check_files,
    read_result,
)
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.manifest import MANIFEST


def pack(folder: Path, out: Path, figures: Figures | None, *, whole: bool = False, force: bool = False) -> Result:
    """Copy a finished result into a new folder, which appears whole or not at all.

    Its manifest stays what it is, so that the copy has the same name (the SHA-256 of its manifest) and says what was
    left out.

    Args:
        folder: Of the result.
        out: The new folder.
        figures: Derives its figures from its rows; None where its kind has no rows.
        whole: Whether to copy splats and pictures, too.
        force: Whether an older result at `out` may be replaced.

    Returns:
        The copy.

    Raises:
        InvalidValueError: A file of the result is missing or was changed, or its rows do not give its figures.
        SplatFileError: `out` is in use or cannot be written.
    """
    result = read_result(folder)
    _check([*check_files(folder), *check_figures(result, figures), *check_detections(result)], folder)
    with new_folder(out, force=force, record=RECORD, manifest=False) as copy:
        for name in result.manifest.files:
            if (whole or name.endswith(KEPT)) and (folder / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / name, copy / name)
        shutil.copyfile(folder / MANIFEST, copy / MANIFEST)
    return read_result(out)


def _check(checks: list[Check], folder: Path) -> None:
    """Raise if a line is red."""
    red = next((one for one in checks if one.passed is False), None)
    if red is not None:
        do = "make the result again: it was changed, or it is not of these rows"
        raise InvalidValueError(message(str(folder), "a result as it was written", f"{red.name}: {red.words}", do))
