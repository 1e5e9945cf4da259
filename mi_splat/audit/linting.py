"""All rules on one splat: of a file as it is stored, or of a scene in memory."""

import dataclasses
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps
from torch import Tensor

from mi_splat.audit.rules import Finding, Severity, Stored, findings_of
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.framing import near_plane_of
from mi_splat.cameras.lens import Lens
from mi_splat.errors import listed
from mi_splat.io.camera_records import describe
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.gltf import COMPONENTS, EXTENSION, Glb, open_glb
from mi_splat.io.loaded import Loaded, arrays_of, as_scene, validated
from mi_splat.io.parsing import Fields
from mi_splat.io.splat_files import load_stored
from mi_splat.render.overdraw import Layers, most_layers
from mi_splat.scene import GaussianScene

SIZE = 1024  # pixels along each side of the image that is counted
HEAVY = 512.0
STOPS = 4096.0
"""Mean layers from which a splat is heavy, and from which the rasteriser of mi-splat
refuses such an image.
"""

_DIRECTIONS = 8
_FOV = math.radians(45)
_POINTS = 20_000
_CORE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overdraw:
    """The worst of the cameras that were tried."""

    camera: Camera  # where from
    # (rows, columns) Gaussians over each other in each tile of 4 x 4 pixels
    layers: Layers
    tried: int  # how many cameras were counted

    @property
    def mean(self) -> float:
        """Mean number of layers over the whole image: the work of a frame."""
        return float(self.layers.mean())

    @property
    def highest(self) -> int:
        """Number of layers in the worst tile."""
        return int(self.layers.max())

    def finding(self) -> Finding | None:
        """What is wrong with it, if anything is."""
        if self.mean < HEAVY:
            return None
        stops = self.mean >= STOPS
        effect = "a renderer stops, or takes seconds" if stops else "it is slow"
        reason = (
            f"From one camera {self.mean:,.0f} Gaussians lie over each other in the"
            f" mean of an image of {SIZE} x {SIZE} pixels, up to {self.highest:,} at"
            f" one place: {effect}."
        )
        return Finding(
            rule="overdraw", severity="error" if stops else "warning", reason=reason
        )


def worst_overdraw(scene: GaussianScene) -> Overdraw | None:
    """Count Gaussians over each pixel from all around the splat and its core, as near
    as shows all of it.
    """
    if not len(scene):
        return None
    cameras = list(_cameras(scene))
    near = near_plane_of(*_ball(scene.means.double()), cameras)
    worst, layers, tried = most_layers(scene, cameras, near=near, stop=STOPS)
    return Overdraw(camera=cameras[worst], layers=layers, tried=tried)


def _ball(points: Tensor) -> tuple[list[float], float]:
    middle = (points.amin(0) + points.amax(0)) / 2
    return middle.tolist(), float((points - middle).norm(dim=1).max())


def _cameras(scene: GaussianScene) -> Iterator[Camera]:
    """From all around the middle 98 % of the means along each axis, and around their
    half near the median if small.
    """
    means = scene.means[:: max(1, len(scene) // _POINTS)].double()
    size = float(scene.scales.amax(1).median())
    low, high = (
        means.kthvalue(1 + round(share * (len(means) - 1)), dim=0).values
        for share in (0.01, 0.99)
    )
    whole = means[((means >= low) & (means <= high)).all(1)]
    far = (means - means.median(0).values).norm(dim=1)
    core = means[far <= far.median()]
    sets = [whole] if len(whole) else []
    if not sets or _ball(core)[1] < _CORE * _ball(whole)[1]:
        sets.append(core)
    for points in sets:
        middle = torch.tensor(_ball(points)[0], dtype=torch.float64)
        away = points - middle
        axes = torch.linalg.eigh(away.T @ away).eigenvectors.T
        directions = torch.cat([axes, -axes, lattice(_DIRECTIONS, -80, 80)])
        along = away @ directions.T
        across = (
            (away.square().sum(1, keepdim=True) - along.square())
            .amax(0)
            .clamp(min=0)
            .sqrt()
        )
        distances = along.amax(0) + (across + size) / math.tan(_FOV / 2)
        for eye in (middle + distances[:, None] * directions).tolist():
            pose = look_at(eye, middle.tolist())
            yield Camera(
                to_world=pose,
                lens=Lens(focal=SIZE / 2 / math.tan(_FOV / 2), size=(SIZE, SIZE)),
            )


def overdraw_picture(worst: Overdraw) -> NDArray[np.uint8]:
    """(H, W, 3) heat of the layers, on a logarithmic scale up to `STOPS`, with the
    scale beneath.
    """
    picture = ImageOps.scale(
        _heat(np.log1p(worst.layers) / math.log1p(STOPS)), 3, Image.Resampling.NEAREST
    )
    width, height = picture.size
    sheet = Image.new("RGB", (width, height + 70), (255, 255, 255))
    sheet.paste(picture, (0, 0))
    sheet.paste(
        _heat(np.tile(np.linspace(0, 1, width - 80), (14, 1))), (40, height + 10)
    )
    draw = ImageDraw.Draw(sheet)
    for layers in (1, 8, 64, int(HEAVY), int(STOPS)):
        x = 40 + (width - 80) * math.log1p(layers) / math.log1p(STOPS)
        draw.line([(x, height + 22), (x, height + 28)], fill=(0, 0, 0))
        draw.text((x, height + 40), f"{layers:,}", fill=(0, 0, 0), anchor="mm")
    draw.text(
        (width / 2, height + 58),
        "Gaussians over each other",
        fill=(0, 0, 0),
        anchor="mm",
    )
    return np.asarray(sheet)


def _heat(share: NDArray[np.float64]) -> Image.Image:
    """Black, red and pale yellow for shares from 0 to 1 and above."""
    grey = Image.fromarray((255 * share.clip(0, 1)).astype(np.uint8))
    return ImageOps.colorize(grey, (0, 0, 0), (255, 240, 170), mid=(200, 50, 60))


# Validator of `KHR_gaussian_splatting`: what a primitive says, the accessors of its
# attributes, and their values.
#
# Sources: extensions/2.0/Khronos/KHR_gaussian_splatting/README.md of
# github.com/KhronosGroup/glTF, and glTF 2.0, sections 3.6.2 (accessors) and 3.7.2
# (meshes). Unlike the reader, which stops at the first fault, it goes on.

# component types of an accessor: NumPy kind, and whether integers are normalised
Kinds = frozenset[tuple[str, bool]]

_FLOAT: Kinds = frozenset({("f4", False)})
_SIGNED: Kinds = _FLOAT | {("i1", True), ("i2", True)}
_UNSIGNED: Kinds = _FLOAT | {("u1", True), ("u2", True)}
_SIZES: Kinds = _UNSIGNED | {("u1", False), ("u2", False)}
_QUANTISED: Kinds = frozenset(
    (kind, normal) for kind in ("i1", "u1", "i2", "u2") for normal in (False, True)
)
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_ATTRIBUTES = {
    "POSITION": ("VEC3", _FLOAT),
    f"{EXTENSION}:ROTATION": ("VEC4", _SIGNED),
    f"{EXTENSION}:SCALE": ("VEC3", _SIZES),
    f"{EXTENSION}:OPACITY": ("SCALAR", _UNSIGNED),
    f"{EXTENSION}:SH_DEGREE_0_COEF_0": ("VEC3", _FLOAT),
}
"""Type and component types of the attributes that have to be there."""
_SH = re.compile(rf"{EXTENSION}:SH_DEGREE_([0-3])_COEF_(\d)")
_WORDS = {
    "kernel": ("ellipse",),
    "colorSpace": ("srgb_rec709_display", "lin_rec709_display"),
    "projection": ("perspective",),
    "sortingMethod": ("cameraDistance",),
}
"""Values that the extension names; others may come from extensions of it."""
# how far from 1 the length of a quaternion may be: half a step of 1/127 in four
# components
_UNIT = 0.01


def validate(document: Glb) -> list[Finding]:
    """What is wrong with the splats of a binary glTF."""
    findings: list[Finding] = []
    splats = 0
    for mesh, fields in enumerate(document.root.objects("meshes")):
        for number, primitive in enumerate(fields.objects("primitives")):
            extensions = primitive.values.get("extensions")
            if isinstance(extensions, Mapping) and EXTENSION in extensions:
                splats += 1
                where = f"mesh {mesh}, primitive {number}: "
                found = _primitive(document, primitive, extensions[EXTENSION])
                findings += [
                    dataclasses.replace(item, reason=where + item.reason)
                    for item in found
                ]
    used = document.root.values.get("extensionsUsed")
    if splats and not (isinstance(used, list) and EXTENSION in used):
        findings.insert(
            0, _finding("extension", f"{EXTENSION} is not listed in extensionsUsed.")
        )
    return findings


def _finding(rule: str, reason: str, severity: Severity = "error") -> Finding:
    return Finding(rule=f"gltf-{rule}", severity=severity, reason=reason)


def _primitive(
    document: Glb, primitive: Fields, extension: object
) -> Iterator[Finding]:
    if primitive.values.get("mode", 4) != 0:
        yield _finding(
            "mode",
            "mode has to be 0 (points), and is"
            f" {primitive.values.get('mode', 4)!r:.40}.",
        )
    yield from _words(extension)
    attributes = primitive.values.get("attributes")
    if not isinstance(attributes, Mapping):
        yield _finding("attribute", "attributes has to be an object.")
        return
    yield from _degrees(attributes)
    known = {
        **_ATTRIBUTES,
        **{name: ("VEC3", _FLOAT) for name in attributes if _SH.fullmatch(name)},
    }
    quantised = document.root.values.get("extensionsUsed")
    if isinstance(quantised, list) and "KHR_mesh_quantization" in quantised:
        known["POSITION"] = ("VEC3", _FLOAT | _QUANTISED)
    counts: dict[str, int] = {}
    for name, (form, kinds) in known.items():
        if name not in attributes:
            yield _finding("attribute", f"the attribute {name} is missing.")
            continue
        accessor, faults = _accessor(document, attributes[name], form, kinds)
        yield from (_finding("accessor", f"{name}: {fault}") for fault in faults)
        if accessor is None or faults:
            continue
        counts[name] = int(accessor["count"])  # type: ignore[call-overload]
        try:
            names = tuple(sorted({kind for kind, _ in kinds}))
            values = document.values(
                primitive.object("attributes"), name, _WIDTHS[form], counts[name], names
            )
        except SplatFileError as error:
            yield _finding("accessor", f"{name}: {error}")
            continue
        yield from _values(name, values, accessor)
    if len(set(counts.values())) > 1:
        got = ", ".join(f"{name} {count}" for name, count in counts.items())
        yield _finding(
            "accessor", f"all attributes need the same count, and have {got:.300}."
        )


def _words(extension: object) -> Iterator[Finding]:
    """What is wrong with the extension object."""
    if not isinstance(extension, Mapping):
        yield _finding("extension", f"{EXTENSION} has to be an object.")
        return
    for name, known in _WORDS.items():
        value = extension.get(name)
        if value is None and name in ("kernel", "colorSpace"):
            yield _finding(
                "extension",
                f"the property {name} is missing; it may be {' or '.join(known)}.",
            )
        elif value is not None and not isinstance(value, str):
            yield _finding("extension", f"the property {name} has to be a string.")
        elif value is not None and value not in known:
            reason = (
                f"the extension names no {name} {value!r:.40}, only"
                f" {' or '.join(known)}: few programs read it."
            )
            yield _finding("extension", reason, "warning")


def _degrees(attributes: Mapping[str, Any]) -> Iterator[Finding]:
    """SH come in whole degrees, each with all below it."""
    matches = [match for match in map(_SH.fullmatch, attributes) if match]
    present = {(int(match[1]), int(match[2])) for match in matches}
    highest = max((degree for degree, _ in present), default=0)
    wanted = {
        (degree, order)
        for degree in range(1, highest + 1)
        for order in range(2 * degree + 1)
    }
    for degree, order in sorted(wanted - present):
        yield _finding(
            "degree",
            f"SH reach degree {highest}, and SH_DEGREE_{degree}_COEF_{order} is"
            " missing.",
        )
    ours = [name for name in attributes if str(name).startswith(EXTENSION + ":")]
    strange = [
        name for name in ours if name not in _ATTRIBUTES and not _SH.fullmatch(name)
    ]
    strange += [
        f"SH_DEGREE_{degree}_COEF_{order}"
        for degree, order in sorted(present)
        if order > 2 * degree
    ]
    if strange:
        yield _finding(
            "attribute",
            f"the extension has no attribute {', '.join(strange)[:200]}.",
            "warning",
        )


def _accessor(
    document: Glb, index: object, form: str, kinds: Kinds
) -> tuple[Mapping[str, object] | None, list[str]]:
    """An accessor, and what is wrong with how it is made."""
    if (
        not isinstance(index, int)
        or isinstance(index, bool)
        or not 0 <= index < len(document.accessors)
    ):
        return None, [f"there is no accessor {index!r:.40}."]
    values = document.accessors[index].values
    faults = []
    component = values.get("componentType")
    kind = (
        COMPONENTS.get(component, "?") if isinstance(component, int) else "?",
        values.get("normalized") is True,
    )
    if values.get("type") != form:
        faults.append(f"the type has to be {form}, and is {values.get('type')!r:.40}.")
    if kind not in kinds:
        names = ", ".join(
            sorted(f"{name}{' normalised' if normal else ''}" for name, normal in kinds)
        )
        got = f"{component!r:.40}{' normalised' if kind[1] else ''}"
        faults.append(f"the component type has to be one of {names}, and is {got}.")
    count = values.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        faults.append(
            f"the count has to be a whole number from 1, and is {count!r:.40}."
        )
    return values, faults


def _values(
    name: str, values: NDArray[np.floating], accessor: Mapping[str, object]
) -> Iterator[Finding]:
    """What is wrong with the values of an attribute."""
    short = name.removeprefix(f"{EXTENSION}:")
    finite = np.isfinite(values).all(1)
    faults = [("it is not finite", ~finite)]
    if short == "OPACITY":
        faults.append(
            ("an opacity lies in [0, 1]", finite & ((values < 0) | (values > 1)).any(1))
        )
    if short == "SCALE":
        negative = finite & (values < 0).any(1)
        if negative.mean() > 0.5:
            drafts = ", and so many are: drafts of the extension had logarithms here"
        else:
            drafts = ""
        faults.append((f"a scale may not be negative{drafts}", negative))
    if short == "ROTATION":
        length = np.linalg.norm(values, axis=1)
        faults.append(
            ("a quaternion has length 1", finite & (np.abs(length - 1) > _UNIT))
        )
    for fault, rows in faults:
        if rows.any():
            yield Finding.of("gltf-values", "error", f"{short}: {fault}.", rows)
    if name == "POSITION" and finite.all():
        yield from _extremes(values, accessor)


def _extremes(
    values: NDArray[np.floating], accessor: Mapping[str, object]
) -> Iterator[Finding]:
    """POSITION has to state its extremes, and viewers frame and cull by them; quantised
    ones are stated unscaled.
    """
    for key, true in (("min", values.min(0)), ("max", values.max(0))):
        stated = accessor.get(key)
        numbers = (
            isinstance(stated, list) and len(stated) == 3 and all(map(_finite, stated))
        )
        if not numbers:
            yield _finding(
                "bounds",
                f"the accessor of POSITION has to state its {key}, three finite"
                " numbers.",
            )
        elif accessor.get("componentType") == 5126 and not np.allclose(
            stated,  # type: ignore[arg-type]
            true,
            rtol=1e-5,
            atol=1e-6,
        ):
            got = f"{stated} where the values have {np.round(true, 6).tolist()}"
            yield _finding("bounds", f"the {key} of POSITION is {got:.200}.")


def _finite(item: object) -> bool:
    """Whether this is a number that float64 can hold."""
    return (
        isinstance(item, int | float)
        and not isinstance(item, bool)
        and abs(item) <= sys.float_info.max
    )


_RENDER_MODE = (
    "The file says that it was trained with antialiasing (the 2D filter of"
    " Mip-Splatting). A renderer that ignores this draws small Gaussians too thick."
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Lint:
    """What the rules say of a splat."""

    findings: tuple[Finding, ...]  # in the order of the rules
    # how many there are, those that are not valid included; None if unread
    gaussians: int | None = None
    # from the worst camera, of the valid ones; None if there are none
    overdraw: Overdraw | None = None

    def __repr__(self) -> str:
        count = "unread" if self.gaussians is None else f"{self.gaussians:,} Gaussians"
        return (
            f"Lint({count}, findings:"
            f" {listed(finding.rule for finding in self.findings)})"
        )

    def document(self) -> dict[str, Any]:
        """As JSON can hold it."""
        cost: dict[str, Any] = {"overdraw": None}
        worst = self.overdraw
        if worst is not None:
            counts = {
                "mean": worst.mean,
                "highest": worst.highest,
                "size": SIZE,
                "cameras": worst.tried,
            }
            cost["overdraw"] = {**counts, "camera": describe("overdraw", worst.camera)}
        return {
            "lint": [dataclasses.asdict(finding) for finding in self.findings],
            "cost": cost,
        }


def lint_file(path: Path, stored: Loaded | None = None) -> Lint:
    """Check a splat file, also one with Gaussians that are not valid; what it holds may
    have been read already.
    """
    try:
        loaded = stored or load_stored(path)
    except SplatFileError:
        is_glb = path.suffix.lower() == ".glb" and path.is_file()
        findings = validate(open_glb(path.read_bytes(), str(path))) if is_glb else []
        if any(finding.severity == "error" for finding in findings):
            return Lint(findings=tuple(findings))
        raise
    return _lint(
        loaded, validate(loaded.document) if isinstance(loaded.document, Glb) else []
    )


def lint_scene(scene: GaussianScene) -> Lint:
    """Check a scene."""
    return _lint(validated(*arrays_of(scene).values()), [])


def _lint(loaded: Loaded, findings: list[Finding]) -> Lint:
    stored = Stored.of(loaded)
    findings = [*findings, *(findings_of(stored) if len(stored.valid) else ())]
    if loaded.is_antialiased:
        findings.append(
            Finding(rule="render-mode", severity="note", reason=_RENDER_MODE)
        )
    valid = slice(None) if stored.valid.all() else stored.valid
    worst = worst_overdraw(
        as_scene({name: value[valid] for name, value in loaded.arrays.items()})
    )
    if worst is not None and (finding := worst.finding()) is not None:
        findings.append(finding)
    return Lint(findings=tuple(findings), gaussians=len(stored.valid), overdraw=worst)
