"""`mi-splat audit`: does a splat show something from some directions only, from where,
and in which Gaussians?
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat.cli.console import UsageError, note, progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import (
    CameraOptions,
    Direction,
    JsonOptions,
    axis_name,
    check_no_input_in,
    up_line,
)
from mi_splat.errors import MiSplatError
from mi_splat.fields import Metavar, OutFile, OutFolder, between

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from mi_splat.audit.results import Audit
    from mi_splat.render.scene_files import SplatScene
    from mi_splat.scene import GaussianScene


EXAMPLES = (
    "audit YOUR_SCENE.ply",
    "audit YOUR_SCENE.ply --out out/street-audit",
    "audit YOUR_SCENE.ply --repair street-repaired.ply",
    "audit YOUR.glb --only lint",
    "audit RECEIVED.ply --against YOUR_SCENE.ply --out out/changes",
    "audit out/capture",
)
FOUND = 3
"""Exit status where something was found."""


@dataclass(frozen=True, kw_only=True)
class AuditOptions(JsonOptions):
    """Detect hidden, view-dependent content and invalid data in a splat file, or
    inconsistent (poisoned) images in a data set.

    Each cone of directions is compared with what the other directions predict for it:
    contradicted, differs (information, no alarm) or consistent. Only the file is used.
    Exit status: 0 consistent or differs, 3 contradicted, two groups of images or an
    error of lint, 1 it could not be judged. For limitations see docs/safe.md. Many
    files: `mi-splat gate`.
    """

    file: Positional[Path]
    """Splat file of any format that is read, scene XML made of splats, or folder of
    images with cameras. Images are compared before any training: where they fall into
    two groups that contradict each other, both are named.
    """
    cameras: Annotated[tuple[str, ...], Metavar("CAMERAS")] = ()
    """Training cameras (formats as in `mi-splat render`, the cameras.json beside a
    splat, for instance): only directions near theirs are compared, because elsewhere an
    honest splat shows fog. Without, directions all around each object.
    """
    up: Direction | None = None
    """Up direction of objects that stand on a ground, and of orbits in --cameras: an
    axis, or three numbers. Without, it is estimated from the ground.
    """
    downscale: Annotated[int, between(1, 64, "times smaller"), Metavar("FACTOR")] = 1
    """Factor by which the images of a set are read smaller. They are compared at 400 to
    800 pixels anyway, so that this only saves time and memory.
    """
    out: OutFolder | None = None
    """Folder for result.json, an image of each contradicted cone of directions (file,
    prediction, from where) or of the one that differs most, the splat coloured by heat,
    the mask of the Gaussians for `mi-splat select --mask`, and an image of overdraw.
    """
    against: Path | None = None
    """Trusted original to compare with: which Gaussians changed, in which attributes
    and by how much; rows may be shuffled. --out then has the two views of both that
    changed most (against.png) and the mask of what changed (changed.npy).
    """
    only: Literal["looks", "lint"] | None = None
    """looks: skip lint; lint: only check the numbers, which is much faster."""
    repair: OutFile | None = None
    """Write a splat that shows from contradicted cones what the other directions
    predict, in the format that this name ends with, and audit it again. Where nothing
    is contradicted nothing is written.
    """
    keep: Literal["outside", "inside"] = "outside"
    """Directions that --repair believes, outside or inside of a contradicted cone; no
    file can say which are genuine.
    """
    force: bool = False
    """Replace an older result in --out, and the file of --repair."""
    strict: bool = False
    """Exit with 3 on "differs" and on any change since --against, too. Warnings of lint
    never change the exit status.
    """


def run(options: AuditOptions) -> int:
    """Audit the file."""
    _check_flags(options)
    _check_outputs(options)
    document = _audited(options)
    show_result(document, *_lines(document), as_json=options.json)
    bad = {"contradicted", "two groups", "error"}
    if options.strict:
        bad |= {"differs", "changed"}
    if bad & _verdicts(document):
        return FOUND
    return 0


def _verdicts(document: dict[str, Any]) -> set[str]:
    """The verdict on looks, the severities of lint, and "changed" if anything is not as
    in the clean file.
    """
    against = document.get("against", {})
    changed = {"changed"} if against.get("changed") or against.get("removed") else set()
    return {
        document["verdict"],
        *changed,
        *(finding["severity"] for finding in document.get("lint", ())),
    }


def _check_flags(options: AuditOptions) -> None:
    """Raise if flags exclude each other, or do not fit the files."""
    from mi_splat.datasets import is_dataset

    is_set = is_dataset(options.file)
    pictures = f"the images {options.file}"
    only_lint = options.only == "lint"
    looks = "appearance to be judged"
    refused: list[tuple[str, object, str, object, str]] = [
        (
            "--against",
            options.against and only_lint,
            looks,
            "--only lint",
            "leave that out",
        ),
        (
            "--repair",
            options.repair and only_lint,
            looks,
            "--only lint",
            "leave that out",
        ),
        (
            "--keep",
            options.keep != "outside" and not options.repair,
            "--repair as well",
            "none",
            "add it",
        ),
        (
            "--downscale",
            options.downscale > 1 and not is_set,
            "images with cameras",
            options.file,
            "leave it out",
        ),
    ]
    for name in ("cameras", "up", "only", "repair", "against") if is_set else ():
        refused.append(
            (f"--{name}", getattr(options, name), "a splat", pictures, "leave it out")
        )
    for flag, is_wrong, expected, got, do in refused:
        if is_wrong:
            raise UsageError.of(flag, expected, got, do)


def _check_outputs(options: AuditOptions) -> None:
    """Raise, before any work is done, unless everything can be written where it is
    wanted.
    """
    from mi_splat.io.folders import check_new_file, check_new_folder, check_not_input
    from mi_splat.io.splat_files import format_to_write

    if options.out is not None:
        check_no_input_in(options.out, options.file, options.against)
        check_new_folder(options.out, force=options.force)
    if options.repair is not None:
        format_to_write(str(options.repair))
        check_not_input(options.repair, options.file, options.against)
        check_new_file(
            options.repair, (options.repair.suffix.lower(),), force=options.force
        )


def _repair(
    scene: GaussianScene,
    judged: Audit,
    again: Callable[[GaussianScene], Audit],
    options: AuditOptions,
) -> dict[str, Any] | None:
    """Write the splat without what was found, and say what is found in that; None where
    nothing was found.
    """
    from mi_splat.audit.repair import repaired
    from mi_splat.io import save_splat

    assert options.repair is not None
    try:
        done = repaired(scene, judged, again, keep=options.keep)
    except MiSplatError as error:
        do = "keep the other side by --keep, or leave --repair out"
        expected = "something left that can be audited again"
        raise MiSplatError.of(
            "--repair", expected, f"a splat of which is said: {error}", do
        ) from error
    if done.scene is scene:
        return None
    save_splat(done.scene, options.repair)
    return {
        "file": str(options.repair),
        "keep": options.keep,
        "coloured_anew": done.coloured,
        "left_out": done.left_out,
        "verdict": done.audit.answer,
    }


def _audited(options: AuditOptions) -> dict[str, Any]:
    from mi_splat.audit.files import document, write
    from mi_splat.audit.linting import lint_file, lint_scene
    from mi_splat.datasets import is_dataset
    from mi_splat.io.errors import SplatFileError
    from mi_splat.io.splat_files import load_stored
    from mi_splat.render.scene_files import open_scene

    path = options.file
    folder = options.out
    if is_dataset(path):
        return _audited_images(path, folder, options)
    with progress(f"auditing {path.name}"):
        loaded = open_scene(path) if path.suffix.lower() == ".xml" else None
        stored = None
        lint = None
        with contextlib.suppress(SplatFileError):  # lint says what is wrong
            stored = None if loaded else load_stored(path)
        if options.only != "looks":
            lint = lint_scene(loaded.scene) if loaded else lint_file(path, stored)
        scene = None
        judged = None
        again = None
        unjudged = "only lint was requested"
        if lint is not None:
            errors = [item.rule for item in lint.findings if item.severity == "error"]
        else:
            errors = []
        if "overdraw" in errors:
            unjudged = "it would stop the renderer, see overdraw"
        elif options.only != "lint":
            try:
                loaded = loaded or open_scene(path, stored=stored)
                scene, judged, again = _with_looks(loaded, options)
            except MiSplatError as error:
                if not errors:
                    raise
                unjudged = " ".join(str(error).split())
        files = list[Path]()
        if folder:
            files = write(
                judged,
                scene,
                folder,
                source=str(path),
                lint=lint,
                unjudged=unjudged,
                force=options.force,
            )
        account = document(judged, lint, unjudged=unjudged)
        if options.repair and scene and judged and again:
            account["repair"] = _repair(scene, judged, again, options)
    return {"file": str(path), **account, "files": [str(file) for file in files]}


def _audited_images(
    path: Path, folder: Path | None, options: AuditOptions
) -> dict[str, Any]:
    from mi_splat.audit.image_files import (
        document_of_images,
        image_names,
        write_image_audit,
    )
    from mi_splat.audit.images import audit_images
    from mi_splat.datasets import load_dataset

    views = load_dataset(path, split=None, downscale=options.downscale)
    with progress(f"comparing the images of {path.name}", total=None) as advance:
        judged = audit_images(views, on_step=lambda done, of: advance())
    account = document_of_images(judged, image_names(views))
    files = list[Path]()
    if folder:
        files = write_image_audit(
            judged,
            views,
            folder,
            account=account,
            source=str(path),
            force=options.force,
        )
    return {"file": str(path), **account, "files": [str(file) for file in files]}


def _with_looks(
    loaded: SplatScene, options: AuditOptions
) -> tuple[GaussianScene, Audit, Callable[[GaussianScene], Audit]]:
    """The splat, what is found in it, and what audits another as it was audited."""
    from attacks.audits.recognition import Recognition
    from mi_splat.audit.against import changes
    from mi_splat.audit.auditing import audit
    from mi_splat.cli.cameras import find_cameras
    from mi_splat.render.scene_files import open_scene

    cameras = None
    if options.cameras:
        wanted = CameraOptions(cameras=options.cameras, up=options.up)
        cameras = tuple(find_cameras(loaded, wanted).values())
    if options.against:
        against = changes(loaded.scene, open_scene(options.against).scene)
    else:
        against = None
    up: Sequence[float] | None = options.up
    if up is None and loaded.up is not None and loaded.up.is_stated:
        note(up_line(loaded.up))
        up = loaded.up.direction
    again = partial(audit, recogniser=Recognition(), cameras=cameras, up=up)
    return loaded.scene, replace(again(loaded.scene), against=against), again


def _lines(document: dict[str, Any]) -> Iterator[str]:
    first, *rest = document["summary"]
    yield f"{document['file']}: {first}"
    if "up" in document:
        rest.append(f"up is {axis_name(document['up'])}")
    if "repair" in document:
        rest.append(_repair_line(document["repair"]))
    for finding in document.get("lint", ()):
        shown = ", ".join(map(str, finding["rows"][:5])) + (
            ", ..." if finding["count"] > 5 else ""
        )
        if finding["count"]:
            where = f" {finding['count']:,} Gaussians (rows {shown})."
        else:
            where = ""
        rest.append(
            f"{finding['severity']}, {finding['rule']}:{where} {finding['reason']}"
        )
    cost = document.get("cost", {}).get("overdraw")
    if cost:
        rest.append(
            f"cost: from the worst camera {cost['mean']:,.0f} Gaussians over each other"
            f" in the mean, {cost['highest']:,} at most"
        )
    yield from (f"  {line}" for line in rest)
    yield from document["files"]


def _repair_line(repair: dict[str, Any] | None) -> str:
    if repair is None:
        return "nothing was found that could be repaired, and nothing is written"
    return (
        f"{repair['file']}: {repair['coloured_anew']:,} Gaussians have the colours that"
        f" directions {repair['keep']} of the cone predict, {repair['left_out']:,} are"
        f" left out; audited again: {repair['verdict']}"
    )
