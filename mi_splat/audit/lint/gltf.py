"""Validator of `KHR_gaussian_splatting`: what a primitive says, the accessors of its attributes, and their values.

Sources: extensions/2.0/Khronos/KHR_gaussian_splatting/README.md of github.com/KhronosGroup/glTF, and glTF 2.0, sections
3.6.2 (accessors) and 3.7.2 (meshes). Unlike the reader, which stops at the first fault, it goes on.
"""

import re
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.audit.lint.rules import Finding, Severity
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.gltf import COMPONENTS, EXTENSION, Glb
from mi_splat.io.parsing import Fields

Kinds = frozenset[tuple[str, bool]]
"""Component types of an accessor: NumPy kind, and whether integers are normalised."""

_FLOAT: Kinds = frozenset({("f4", False)})
_SIGNED: Kinds = _FLOAT | {("i1", True), ("i2", True)}
_UNSIGNED: Kinds = _FLOAT | {("u1", True), ("u2", True)}
_SIZES: Kinds = _UNSIGNED | {("u1", False), ("u2", False)}
_QUANTISED: Kinds = frozenset((kind, normal) for kind in ("i1", "u1", "i2", "u2") for normal in (False, True))
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
_UNIT = 0.01
"""How far from 1 the length of a quaternion may be: half a step of 1/127 in four components."""


def validate(document: Glb) -> list[Finding]:
    """What is wrong with the splats of a binary glTF.

    Rows count from the first Gaussian of the primitive that a finding names.
    """
    findings: list[Finding] = []
    splats = 0
    for mesh, fields in enumerate(document.root.objects("meshes")):
        for number, primitive in enumerate(fields.objects("primitives")):
            extensions = primitive.values.get("extensions")
            if isinstance(extensions, Mapping) and EXTENSION in extensions:
                splats += 1
                where = f"mesh {mesh}, primitive {number}: "
                findings += _primitive(document, primitive, extensions[EXTENSION], where)
    used = document.root.values.get("extensionsUsed")
    if splats and not (isinstance(used, list) and EXTENSION in used):
        findings.insert(0, _finding("extension", f"{EXTENSION} is not listed in extensionsUsed."))
    return findings


def _finding(rule: str, reason: str, severity: Severity = "error") -> Finding:
    return Finding(rule=f"gltf-{rule}", severity=severity, reason=reason)


def _primitive(document: Glb, primitive: Fields, extension: object, where: str) -> Iterator[Finding]:
    if primitive.values.get("mode", 4) != 0:
        yield _finding("mode", f"{where}mode has to be 0 (points), and is {primitive.values.get('mode', 4)!r:.40}.")
    yield from _words(extension, where)
    attributes = primitive.values.get("attributes")
    if not isinstance(attributes, Mapping):
        yield _finding("attribute", f"{where}attributes has to be an object.")
        return
    yield from _degrees(attributes, where)
    known = {**_ATTRIBUTES, **{name: ("VEC3", _FLOAT) for name in attributes if _SH.fullmatch(name)}}
    quantised = document.root.values.get("extensionsUsed")
    if isinstance(quantised, list) and "KHR_mesh_quantization" in quantised:
        known["POSITION"] = ("VEC3", _FLOAT | _QUANTISED)
    counts: dict[str, int] = {}
    for name, (form, kinds) in known.items():
        if name not in attributes:
            yield _finding("attribute", f"{where}the attribute {name} is missing.")
            continue
        accessor, faults = _accessor(document, attributes[name], form, kinds)
        yield from (_finding("accessor", f"{where}{name}: {fault}") for fault in faults)
        if accessor is None or faults:
            continue
        counts[name] = int(accessor["count"])  # type: ignore[call-overload]
        try:
            names = tuple(sorted({kind for kind, _ in kinds}))
            values = document.values(primitive.object("attributes"), name, _WIDTHS[form], counts[name], names)
        except SplatFileError as error:
            yield _finding("accessor", f"{where}{name}: {error}")
            continue
        yield from _values(name, values, accessor, where)
    if len(set(counts.values())) > 1:
        got = ", ".join(f"{name} {count}" for name, count in counts.items())
        yield _finding("accessor", f"{where}all attributes need the same count, and have {got:.300}.")


def _words(extension: object, where: str) -> Iterator[Finding]:
    """What is wrong with the extension object."""
    if not isinstance(extension, Mapping):
        yield _finding("extension", f"{where}{EXTENSION} has to be an object.")
        return
    for name, known in _WORDS.items():
        value = extension.get(name)
        if value is None and name in ("kernel", "colorSpace"):
            yield _finding("extension", f"{where}the property {name} is missing; it may be {' or '.join(known)}.")
        elif value is not None and not isinstance(value, str):
            yield _finding("extension", f"{where}the property {name} has to be a string.")
        elif value is not None and value not in known:
            expected = " or ".join(known)
            reason = f"{where}the extension names no {name} {value!r:.40}, only {expected}: few programs will read it."
            yield _finding("extension", reason, "warning")


def _degrees(attributes: Mapping[str, Any], where: str) -> Iterator[Finding]:
    """SH come in whole degrees, each with all below it."""
    matches = [match for match in map(_SH.fullmatch, attributes) if match]
    present = {(int(match[1]), int(match[2])) for match in matches}
    highest = max((degree for degree, _ in present), default=0)
    wanted = {(degree, order) for degree in range(1, highest + 1) for order in range(2 * degree + 1)}
    for degree, order in sorted(wanted - present):
        reason = f"{where}SH reach degree {highest}, and SH_DEGREE_{degree}_COEF_{order} is missing."
        yield _finding("degree", reason)
    ours = [name for name in attributes if str(name).startswith(EXTENSION + ":")]
    strange = [name for name in ours if name not in _ATTRIBUTES and not _SH.fullmatch(name)]
    strange += [f"SH_DEGREE_{degree}_COEF_{order}" for degree, order in sorted(present) if order > 2 * degree]
    if strange:
        yield _finding("attribute", f"{where}the extension has no attribute {', '.join(strange)[:200]}.", "warning")


def _accessor(document: Glb, index: object, form: str, kinds: Kinds) -> tuple[Mapping[str, object] | None, list[str]]:
    """An accessor, and what is wrong with how it is made."""
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(document.accessors):
        return None, [f"there is no accessor {index!r:.40}."]
    values, faults = document.accessors[index].values, []
    component = values.get("componentType")
    kind = (COMPONENTS.get(component, "?") if isinstance(component, int) else "?", values.get("normalized") is True)
    if values.get("type") != form:
        faults.append(f"the type has to be {form}, and is {values.get('type')!r:.40}.")
    if kind not in kinds:
        names = ", ".join(sorted(f"{name}{' normalised' if normal else ''}" for name, normal in kinds))
        got = f"{component!r:.40}{' normalised' if kind[1] else ''}"
        faults.append(f"the component type has to be one of {names}, and is {got}.")
    count = values.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        faults.append(f"the count has to be a whole number from 1, and is {count!r:.40}.")
    return values, faults


def _values(name: str, values: NDArray[np.floating], accessor: Mapping[str, object], where: str) -> Iterator[Finding]:
    """What is wrong with the values of an attribute."""
    short = name.removeprefix(f"{EXTENSION}:")
    finite = np.isfinite(values).all(1)
    faults = [("it is not finite", ~finite)]
    if short == "OPACITY":
        faults.append(("an opacity lies in [0, 1]", finite & ((values < 0) | (values > 1)).any(1)))
    if short == "SCALE":
        negative = finite & (values < 0).any(1)
        drafts = ", and so many are: drafts of the extension had logarithms here" if negative.mean() > 0.5 else ""
        faults.append((f"a scale may not be negative{drafts}", negative))
    if short == "ROTATION":
        length = np.linalg.norm(values, axis=1)
        faults.append(("a quaternion has length 1", finite & (np.abs(length - 1) > _UNIT)))
    for fault, rows in faults:
        if rows.any():
            yield Finding.of("gltf-values", "error", f"{where}{short}: {fault}.", rows)
    if name == "POSITION" and finite.all():
        yield from _extremes(values, accessor, where)


def _extremes(values: NDArray[np.floating], accessor: Mapping[str, object], where: str) -> Iterator[Finding]:
    """POSITION has to state its extremes, and viewers frame and cull by them; quantised ones are stated unscaled."""
    for key, true in (("min", values.min(0)), ("max", values.max(0))):
        stated = accessor.get(key)
        numbers = isinstance(stated, list) and len(stated) == 3 and all(map(_finite, stated))
        if not numbers:
            yield _finding("bounds", f"{where}the accessor of POSITION has to state its {key}, three finite numbers.")
        elif accessor.get("componentType") == 5126 and not np.allclose(stated, true, rtol=1e-5, atol=1e-6):  # type: ignore[arg-type]
            got = f"{stated} where the values have {np.round(true, 6).tolist()}"
            yield _finding("bounds", f"{where}the {key} of POSITION is {got:.200}.")


def _finite(item: object) -> bool:
    """Whether this is a number that float64 can hold."""
    return isinstance(item, int | float) and not isinstance(item, bool) and abs(item) <= sys.float_info.max
