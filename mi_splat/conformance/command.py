"""The command of the distribution `splat-conformance`: the pack, and comparisons with
it, with nothing but NumPy.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

from mi_splat.conformance.catalogue import catalogue_lines
from mi_splat.conformance.comparison import Report, compare
from mi_splat.conformance.deviations import PROFILES
from mi_splat.conformance.gradients import GradientReport, compare_gradients
from mi_splat.errors import InvalidValueError

DIFFERS = 3
"""Exit status where something does not conform, or is missing."""
PACK = Path(__file__).parent / "pack"
"""Where the wheel has its files."""


def main(words: list[str] | None = None) -> int:
    """Run a command, and return its exit status: 0 where all conforms, 3 where not, 1
    where files cannot be compared.
    """
    options = _parser().parse_args(words)
    try:
        status: int = options.run(options)
    except (InvalidValueError, OSError) as error:
        sys.stderr.write(f"splat-conformance: {error}\n")
        return 1
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splat-conformance",
        description=(
            "Test a renderer against the definition of 3D Gaussian Splatting, and name"
            " what it does differently."
        ),
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="what is tested, deviations, profiles")
    listing.set_defaults(run=_list)
    export = commands.add_parser("export", help="write the pack into a new folder")
    export.add_argument("folder", type=Path)
    export.set_defaults(run=_export)
    images = commands.add_parser("compare", help="compare a folder of images")
    images.add_argument("folder", type=Path, help="NAME.png or NAME.npy of each splat")
    images.add_argument("--profile", default="3dgs", help=", ".join(PROFILES))
    images.add_argument(
        "--accept",
        nargs="+",
        default=(),
        metavar="NAME",
        help="deviations that are meant, and scenes to leave out; see list",
    )
    images.add_argument(
        "--cannot",
        nargs="+",
        default=(),
        metavar="NAME",
        help="what the renderer lacks, so that scenes are not applicable; see list",
    )
    images.set_defaults(run=_compare)
    gradients = commands.add_parser("gradients", help="compare a folder of gradients")
    gradients.add_argument("folder", type=Path, help="NAME.npz of each splat")
    gradients.set_defaults(run=_compare_gradients)
    for command in (images, gradients):
        command.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")


def _list(_: argparse.Namespace) -> int:
    _say("\n".join(catalogue_lines()))
    return 0


def _export(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    if folder.exists():
        raise InvalidValueError.of(
            str(folder), "a new folder", "one that exists", "name another"
        )
    shutil.copytree(PACK, folder)
    _say(f"{folder}: splats, cameras, reference images and gradients")
    return 0


def _compare(options: argparse.Namespace) -> int:
    report = compare(options.folder, options.profile, options.accept, options.cannot)
    return _show(report, as_json=options.json)


def _compare_gradients(options: argparse.Namespace) -> int:
    return _show(compare_gradients(options.folder), as_json=options.json)


def _show(report: Report | GradientReport, *, as_json: bool) -> int:
    _say(json.dumps(report.as_dict(), indent=2) if as_json else str(report))
    return 0 if report.conforms else DIFFERS


if __name__ == "__main__":
    sys.exit(main())
