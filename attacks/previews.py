"""The cards of what attacks give: results, poisoned sets and what detectors see; see `mi_splat.previews`."""

from __future__ import annotations

from itertools import islice

from attacks.dagger.report import before_and_after
from attacks.dagger.result import Result
from attacks.observe.drawing import annotated
from attacks.observe.judge import Judged
from attacks.poisons.base import Poisoned
from mi_splat.cards import picture
from mi_splat.previews import drawn, html

__all__ = ["html"]

_PAIRS = 2
"""Views that a card shows at most, before and after."""
_WIDE, _NARROW = 720, 280
"""Pixels that a pair of pictures with boxes is wide, so that labels can be read, and a single one."""


@html.register
def _result(value: Result) -> str:
    views = value.views_of(value.detectors[0])[:_PAIRS]
    return drawn(value, lambda: [picture(before_and_after(view), width=_WIDE, height=_WIDE) for view in views])


@html.register
def _judged(value: Judged) -> str:
    def draw() -> list[str]:
        firsts = ((name, views[0]) for name, views in islice(value.views.items(), 2 * _PAIRS))
        return [
            picture(annotated(view.image, view.detections, f"{name} ({view.detector})"), width=_NARROW, height=_WIDE)
            for name, view in firsts
        ]

    return drawn(value, draw)


@html.register
def _poisoned(value: Poisoned) -> str:
    def draw() -> list[str]:
        indices = [change.index for change in value.changes[:_PAIRS]]
        return [
            picture(views[index].image, f"view {index}, {name}")
            for index in indices
            for name, views in (("clean", value.views.untouched), ("poisoned", value.views))
        ]

    return drawn(value, draw)
