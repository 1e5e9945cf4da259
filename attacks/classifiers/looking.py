"""What a classifier takes pictures for, as rows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from attacks.classifiers.base import Classifier
from attacks.classifiers.frozen import class_number


def classified(classifier: Classifier, pictures: Iterable[Tensor], label: str) -> list[dict[str, Any]]:
    """A row for each picture: `view`, its position; `classifier`; `top1`; `right`; `confidence` in the true class."""
    true, rows = class_number(classifier, label, "label"), list[dict[str, Any]]()
    for view, picture in enumerate(pictures):
        with torch.no_grad():
            confidence = torch.softmax(classifier.scores(picture[None])[0].double(), 0)
        top1 = classifier.classes[int(confidence.argmax())]
        row = {"view": view, "classifier": classifier.name, "top1": top1}
        rows.append({**row, "right": top1 == label, "confidence": float(confidence[true])})
    return rows
