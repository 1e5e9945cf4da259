"""The detectors of others, where they have been got."""

from __future__ import annotations

import pytest

from attacks.detectors.coco import cards
from attacks.detectors.coco.sources import PUBLISHED, graph_of, weights_of
from attacks.detectors.tfjs.files import load_graph_model


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_was_got_is_whole_and_of_the_stated_size(name: str) -> None:
    detector = PUBLISHED[name]
    if not weights_of(name).is_file():
        pytest.skip(f"{name} is not here: mi-splat detectors --get {name}")
    assert cards.flaw(detector) == ""
    graph = load_graph_model(graph_of(name), weights_of(name))
    numbers = sum(value.numel() for value in graph.constants.values() if value.is_floating_point())
    assert numbers / 1e6 == pytest.approx(detector.parameters, abs=0.05)
    (shape,) = graph.inputs.values()
    assert [size for size in shape if size not in (1, 3)] == list(detector.input_size)
