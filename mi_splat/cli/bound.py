"""`mi-splat bound`: a copy of a splat whose colours hardly depend on the direction,
with a certificate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mi_splat.cli.console import UsageError, progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFile, above

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mi_splat.scene import GaussianScene

EXAMPLES = (
    "bound RECEIVED.ply --out safe.ply",
    "bound RECEIVED.ply --out safe.ply --eps 0.02 --keep mirror.npy",
    "bound safe.ply --verify",
)
BROKEN = 3
"""Exit status where a file is not within its bound."""
CERTIFICATE = ".bound.json"
"""What follows the name of a splat in the name of its certificate."""
LARGEST = 1 << 20  # bytes of one that is read
EPS = 0.05
UNCHANGED = 99.0  # dB where nothing is to be seen of a change
Eps = Annotated[float, above(0, "sRGB", "0.05 is hardly seen"), Metavar("SRGB")]


@dataclass(frozen=True, kw_only=True)
class BoundOptions(JsonOptions):
    """Write a copy of a splat in which no Gaussian's colour departs by more than --eps
    from a consensus of the directions that show it, and a certificate beside it.

    What a splat shows from some directions only is thus bounded, whether or not an
    audit finds it. Nothing is promised of colours that are the same from everywhere,
    nor of geometry, and honest gloss fades; the price is printed. Exit status: 0, or 3
    where --verify finds more than the bound.
    """

    file: Positional[Path]
    """Splat file of any format that is read."""
    out: OutFile | None = None
    """The copy, in the format that this name ends with; its certificate is beside
    it.
    """
    eps: Eps | None = None
    """Largest departure of a colour; none is 0.05, and with --verify what the
    certificate states, if there is one.
    """
    cameras: Annotated[tuple[str, ...], Metavar("CAMERAS")] = ()
    """Those of the training images, in the forms that `mi-splat render` takes: the
    consensus is of what they see, and so is the price. Without, of cameras around each
    object, which costs more where no training camera stood.
    """
    keep: Path | None = None
    """Mask of Gaussians that may depart further, of `mi-splat select`: an object whose
    gloss you trust.
    """
    keep_eps: Eps = 0.5
    """Their largest departure."""
    verify: bool = False
    """Write nothing, and say whether the file is within the bound."""
    force: bool = False
    """Replace a file that is there."""


def run(options: BoundOptions) -> int:
    """Bound a splat, or check one that is said to be."""
    if options.verify == (options.out is not None):
        expected = "one of --out and --verify"
        got = "both" if options.verify else "none"
        raise UsageError.of("--out", expected, got, "choose one of them")
    if options.verify:
        return _verify(options)
    _bound(options)
    return 0


def certificate_of(file: Path) -> Path:
    """Where the certificate of a splat is."""
    return file.with_name(file.name + CERTIFICATE)


def _bound(options: BoundOptions) -> None:
    from mi_splat.audit.bound import bounded
    from mi_splat.cli.cameras import find_cameras
    from mi_splat.io import load_splat, save_splat
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import check_free_file, check_not_input
    from mi_splat.io.splat_files import format_to_write
    from mi_splat.provenance import origin
    from mi_splat.render.scene_files import open_scene
    from mi_splat.selection.select import load_mask

    out = options.out
    assert out is not None
    format_to_write(str(out))
    certificate = certificate_of(out)
    check_not_input(out, options.file)
    for file in (out, certificate):
        check_free_file(file, force=options.force)
    eps = options.eps or EPS
    with progress(f"bounding {options.file.name}"):
        loaded = open_scene(options.file)
        scene = loaded.scene
        cameras = None
        if options.cameras:
            wanted = CameraOptions(cameras=options.cameras)
            cameras = tuple(find_cameras(loaded, wanted).values())
        keep = None if options.keep is None else load_mask(options.keep, scene)
        done = bounded(
            scene, eps, keep=keep, keep_eps=options.keep_eps, cameras=cameras
        )
        out.parent.mkdir(parents=True, exist_ok=True)
        save_splat(done.scene, out)
        facts = facts_of(load_splat(out), eps)
    most = 0 if keep is None else int(keep.sum())
    if facts["beyond"] > most:
        out.unlink()
        expected = f"at most {most:,} Gaussians beyond {eps:g}"
        do = "write a .ply: this format rounds colours"
        raise InvalidValueError.of(str(out), expected, facts["beyond"], do)
    mean = sum(min(value, UNCHANGED) for value in done.psnr) / len(done.psnr)
    lowest = min(*done.psnr, UNCHANGED)
    facts |= {
        "changed": int(done.changed.sum()),
        "price": {"psnr_mean": mean, "psnr_lowest": lowest, "cameras": len(done.psnr)},
    }
    save_json({"source": str(options.file), **facts, **origin()}, certificate)
    show_result(
        {"file": str(options.file), "out": str(out), **facts},
        f"{out}: {facts['changed']:,} of {facts['gaussians']:,} Gaussians changed",
        _in_words(facts),
        f"price: {mean:.1f} dB to the file in the mean of {len(done.psnr)} cameras,"
        f" {lowest:.1f} dB from the worst",
        str(certificate),
        as_json=options.json,
    )


def facts_of(scene: GaussianScene, eps: float) -> dict[str, Any]:
    """What a certificate says of a splat, all of which follows from the splat alone."""
    from mi_splat.audit.bound import colour_bound
    from mi_splat.scene import scene_hash

    reach = colour_bound(scene)
    is_beyond = reach > eps
    within = reach[~is_beyond]
    return {
        "eps": eps,
        "bound": float(within.max()) if len(within) else 0.0,
        "beyond": int(is_beyond.sum()),
        "largest": float(reach.max()) if len(reach) else 0.0,
        "gaussians": len(scene),
        "scene_hash": scene_hash(scene),
    }


def read_certificate(path: Path) -> dict[str, Any]:
    """What a certificate states, if it is one: it may be anybody's."""
    from mi_splat.io.parsing import DocumentReader

    expected = "the certificate of a bounded copy"
    do = "bound the splat again"
    reader = DocumentReader(expected=expected, do=do, most=LARGEST)
    stated = reader.read_json(path)
    is_table = isinstance(stated, dict)
    eps = stated.get("eps") if is_table else None
    beyond = stated.get("beyond", 0) if is_table else None
    is_known = isinstance(eps, int | float) and math.isfinite(eps) and eps > 0
    if not is_known or type(beyond) is not int or beyond < 0:
        raise InvalidValueError.of(str(path), expected, "something else", do)
    return dict(stated)


def _in_words(facts: Mapping[str, Any]) -> str:
    """The bound in a sentence."""
    beyond = ""
    if facts["beyond"]:
        beyond = f" but for {facts['beyond']:,} Gaussians, by {facts['largest']:.4f}"
    return (
        f"no colour departs by more than {facts['bound']:.4f} of {facts['eps']:g}"
        f" in any direction{beyond}"
    )


def _verify(options: BoundOptions) -> int:
    """Whether a file is what its certificate says, or within --eps without one."""
    from mi_splat.io import load_splat

    certificate = certificate_of(options.file)
    stated = read_certificate(certificate) if certificate.exists() else {}
    with progress(f"checking {options.file.name}"):
        eps = options.eps or stated.get("eps", EPS)
        facts = facts_of(load_splat(options.file), eps)
    faults = []
    if stated and stated.get("scene_hash") != facts["scene_hash"]:
        faults.append("the certificate belongs to another file")
    if facts["beyond"] > stated.get("beyond", 0):
        faults.append(f"{facts['beyond']:,} Gaussians depart by more than {eps:g}")
    document = {
        "file": str(options.file),
        **facts,
        "certificate": str(certificate) if stated else None,
        "faults": faults,
    }
    verdict = "not within its bound" if faults else "within its bound"
    show_result(
        document,
        f"{options.file}: {verdict}",
        _in_words(facts),
        *faults,
        as_json=options.json,
    )
    return BROKEN if faults else 0
