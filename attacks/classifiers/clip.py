"""Adapter to CLIP (Radford et al., arXiv 2103.00020) of the library transformers: a zero-shot classifier.

A class becomes a text, whose features are compared with those of the picture. Features of the texts are computed once;
what is kept of the network is its half for pictures. Both halves come from files: nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from attacks.classifiers.frozen import FrozenClassifier, Preparation, ZeroShot, check_classes
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.weights import check_finite, keep_gradients_right
from mi_splat.errors import InvalidValueError

PROMPT = "a photo of a {}"
"""Text of a class. M-IFGSM was published with the bare name, "{}"."""
_FILES = "model.safetensors, config.json, preprocessor_config.json and the tokenizer's files, as save_pretrained writes"
_MODES = {2: "bilinear", 3: "bicubic"}
"""Pillow's numbers."""


def load(network: str, weights: Path | None, classes: Sequence[str] | None) -> FrozenClassifier:
    """As the registry calls it; there are no usual classes."""
    if classes is None:
        raise InvalidValueError.of("classes of clip", "a list of names", "none", "say what it shall tell apart")
    return load_clip(weights, classes)


def load_clip(folder: Path | None, classes: Sequence[str], *, prompt: str = PROMPT) -> FrozenClassifier:
    """CLIP of the library transformers."""
    texts = _texts(classes, prompt)
    from attacks.detectors.transformers import loading, model_folder, require_all  # says what to install

    if folder is None:
        raise DetectorError.of("weights of clip", f"a folder of {_FILES}", "none", "name one")
    from transformers import AutoTokenizer, CLIPImageProcessor, CLIPModel

    where: dict[str, Any] = {"pretrained_model_name_or_path": model_folder(Path(folder)), "local_files_only": True}
    with loading(folder):
        model, report = CLIPModel.from_pretrained(**where, dtype=torch.float32, output_loading_info=True)
        processor = CLIPImageProcessor.from_pretrained(**where)
        tokenizer = AutoTokenizer.from_pretrained(**where)
    require_all(report, folder)
    check_finite(model.state_dict(), f"weights of {folder}")
    model.eval()
    with torch.no_grad():
        tokens = tokenizer(texts, padding=True, truncation=True, return_tensors="pt")
        embedded = model.get_text_features(tokens["input_ids"], tokens["attention_mask"])
    prepare = Preparation(
        size=processor.crop_size["height"],
        shorter=processor.size["shortest_edge"],
        mean=tuple(processor.image_mean),
        deviation=tuple(processor.image_std),
        mode=_MODES[int(processor.resample)],
    )
    encoder = _TransformersEncoder(model.vision_model, model.visual_projection)
    directions, scale = normalize(embedded.pooler_output, dim=1), float(model.logit_scale.detach().exp())
    compared = ZeroShot(encoder, directions, temperature=scale)
    keep_gradients_right(compared)
    return FrozenClassifier("clip", compared, classes, prepare)


class _TransformersEncoder(nn.Module):
    """The half of the library's CLIPModel for pictures."""

    def __init__(self, vision: nn.Module, projection: nn.Module) -> None:
        super().__init__()
        self.vision, self.projection = vision, projection

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, S, S) to (B, F)."""
        features: Tensor = self.projection(self.vision(pixel_values=pictures).pooler_output)
        return features


def _texts(classes: Sequence[str], prompt: str) -> list[str]:
    """The text of each class."""
    if "{}" not in prompt:
        raise InvalidValueError.of("prompt", "a text with {} in the place of the class", repr(prompt), PROMPT)
    return [prompt.replace("{}", name) for name in check_classes(classes)]
