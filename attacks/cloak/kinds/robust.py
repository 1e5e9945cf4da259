"""A splat that a victim trains who audits the images first, and leaves out those that
the audit names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.trained import VARIES, TrainedConfig, train_on
from attacks.cloak.setup import SET
from mi_splat.audit.image_files import document_of_images, image_names
from mi_splat.audit.images import audit_images
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json

if TYPE_CHECKING:
    from mi_splat.ledger import Out

__all__ = ["VARIES", "RobustConfig", "run"]

AUDIT = "images.json"


class RobustConfig(TrainedConfig):
    """How the victim trains on the images that are left."""


def run(config: RobustConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Train on the `pictures` without group B, or go on; `AUDIT` has the names."""
    folder = inputs["pictures"] / SET
    views = load_dataset(folder, split="train", background=config.background)
    audit = audit_images(views)
    if audit.is_nearly_equal:
        do = "look at the images, and leave out those that are not true"
        raise InvalidValueError.of(
            str(folder), "one group larger than the other", "equal groups", do
        )
    save_json(document_of_images(audit, image_names(views)), out / AUDIT)
    dropped = audit.left_out("A").nonzero()[:, 0].tolist()
    kept = views.without(frozenset(views.paths[number] for number in dropped))
    train_on(kept, config, inputs, out)
