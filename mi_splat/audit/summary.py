"""What an audit has to say, in sentences: what was found, from where, what gloss explains, what was not looked at."""

import math

from mi_splat.audit.results import SUSPICION, Audit, Edit, ObjectAudit, Region, Vector

_STEEP, _LEVEL = 60.0, 15.0
"""Degrees above the ground from which a direction is from above, and up to which it is from the side."""

_ALL = 0.995
"""Share of the solid Gaussians near what was looked at, from which a splat was looked at whole."""


def directions_in_words(region: Region, up: Vector | None) -> str:
    """The directions of a region, as a part of a sentence."""
    axis = " ".join(f"{value + 0.0:.2f}" for value in region.axis)
    if region.elevation is not None:
        low, high = region.elevation
        text = (
            f"{region.half_width:.0f} degrees of azimuth to each side of ({axis}), {low:.0f} to {high:.0f} above ground"
        )
    else:
        text = f"{region.half_width:.0f} degrees of ({axis}){_height(region.axis, up)}"
    return f"{'from everywhere but ' if region.complement else ''}within {text}"


def _height(axis: Vector, up: Vector | None) -> str:
    if up is None:
        return ""
    cosine = math.fsum(a * b for a, b in zip(axis, up, strict=True))
    height = math.degrees(math.asin(max(-1.0, min(1.0, cosine))))
    if height >= _STEEP:
        return ", from above"
    return ", from the side" if abs(height) <= _LEVEL else f", {height:.0f} degrees above its ground"


def headline(audit: Audit) -> str:
    """The verdict and where it is from, in one sentence."""
    item = audit.strongest
    if item.evidence < SUSPICION and item.edit is not None and item.edited:
        return f"{audit.verdict}: colours of an object look edited{_aim(item.edit)}"
    if audit.verdict == "nothing found":
        part = "" if audit.near >= _ALL else f" in the {audit.near:.0%} of its solid Gaussians that were looked at"
        return f"nothing found{part}: no set of directions explains how colours change better than honest gloss does"
    if item.occluder is not None and (item.look.evidence < SUSPICION or item.occluder.evidence >= 1):
        axis = " ".join(f"{value + 0.0:.2f}" for value in item.occluder.axis)
        return f"{audit.verdict}: something in the air covers an object from around ({axis}), and others see through it"
    where = directions_in_words(item.look.region, item.up)
    room = "; in a room an honest object may, too: look at the two pictures, or pass --cameras" if item.in_room else ""
    return f"{audit.verdict}: an object has other colours {where}{room}"


def _aim(edit: Edit) -> str:
    if not edit.camera_known:
        return ""
    return f", aimed at a camera towards ({' '.join(f'{value + 0.0:.2f}' for value in edit.direction)})"


def summary(audit: Audit) -> list[str]:
    """The whole account, sentence by sentence."""
    lines = [headline(audit)]
    for number, item in enumerate(audit.objects, 1):
        lines.append(f"object {number}, {_where(item)}: {'; '.join(_of_object(item))}")
    if audit.against is not None:
        lines += audit.against.in_words()
    count = int(audit.mask.sum())
    if count:
        lines.append(f"{count:,} of {len(audit.mask):,} Gaussians carry it")
    lines.append(
        f"{audit.near:.0%} of the solid Gaussians lie near an object that was looked at; nothing is said of the others"
    )
    return lines


def _where(item: ObjectAudit) -> str:
    centre = " ".join(f"{value + 0.0:.3g}" for value in item.centre)
    return f"{len(item.rows):,} Gaussians around ({centre})"


def _of_object(item: ObjectAudit) -> list[str]:
    lines: list[str] = [item.verdict]
    for number, look in enumerate(item.looks, 1):
        rival = "the angle of incidence" if look.incidence > look.mirror else "a mirrored direction"
        lines.append(
            (f"look {number}: " if len(item.looks) > 1 else "")
            + f"score {look.score:.4f} by direction, {max(look.incidence, look.mirror):.4f} by {rival}, "
            f"common to faces that look different ways: {look.shift:.4f}, and {look.fade:.0%} of the contrast; "
            f"excess {look.excess:.4f}"
        )
        if look.evidence >= SUSPICION:
            cameras = f"{int(look.shown.sum())} of {len(look.shown)} cameras"
            lines.append(f"{look.area / max(item.area, 1e-12):.0%} of its surface changes; seen by {cameras}")
        if number > 1:
            lines.append(f"it shows {directions_in_words(look.region, item.up)}")
    if item.occluder is not None and item.covered:
        lines.append(f"{item.occluder.transparent:.0%} of the looks from other directions pass what covers it")
    if item.edit is not None and item.edited:
        lines.append(
            f"its colours look like an attack on a detector{_aim(item.edit)}: {item.edit.score:.1f} times the bound"
        )
    open_share = item.uncontradicted / max(item.uncontradicted + item.area, 1e-12)
    lines.append(f"{open_share:.0%} of what shows is seen from one side or by few cameras: nothing contradicts it")
    return lines
