"""The cards of what attacks give: results, poisoned sets and what detectors see; see `mi_splat.cards`."""

from collections.abc import Iterable
from itertools import islice

from attacks.dagger.report import before_and_after
from attacks.dagger.result import Result
from attacks.observe.comparison import Judged
from attacks.observe.drawing import annotated
from attacks.poisons.base import Poisoned
from mi_splat.cards import html, image, images

__all__ = ["html"]

_PAIRS = 2
"""Views that a card shows at most, before and after."""
_WIDE, _NARROW = 720, 280
"""Pixels that a pair of images with boxes is wide, so that labels can be read, and a single one."""


@images.register
def _(value: Result) -> Iterable[str]:
    views = value.pictures[:_PAIRS]
    return [image(before_and_after(view), width=_WIDE, height=_WIDE) for view in views]


@images.register
def _(value: Judged) -> Iterable[str]:
    firsts = ((name, views[0]) for name, views in islice(value.views.items(), 2 * _PAIRS))
    return [
        image(annotated(view.image, view.detections, f"{name} ({view.detector})"), width=_NARROW, height=_WIDE)
        for name, view in firsts
    ]


@images.register
def _(value: Poisoned) -> Iterable[str]:
    return [
        image(views[change.index].image, f"view {change.index}, {name}")
        for change in value.changes[:_PAIRS]
        for name, views in (("clean", value.views.untouched), ("poisoned", value.views))
    ]
