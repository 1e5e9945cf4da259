"""Adapters to CLIP (Radford et al., arXiv 2103.00020) of transformers and open_clip: zero-shot classifiers.

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
from attacks.detectors.weights import check_finite, keep_gradients_right, one_line
from mi_splat.errors import InvalidValueError, install

PROMPT = "a photo of a {}"
"""Text of a class. M-IFGSM was published with the bare name, "{}"."""
_FILES = "model.safetensors, config.json, preprocessor_config.json and the tokenizer's files, as save_pretrained writes"
_MODES = {2: "bilinear", 3: "bicubic"}
"""Pillow's numbers."""


def load(network: str, weights: Path | None, classes: Sequence[str] | None) -> FrozenClassifier:
    """As the registry calls it, with an architecture of open_clip or none; there are no usual classes."""
    if classes is None:
        name = "open_clip" if network else "clip"
        raise InvalidValueError.of(f"classes of {name}", "a list of names", "none", "say what it shall tell apart")
    return load_open_clip(network, weights, classes) if network else load_clip(weights, classes)


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
    return _classifier("clip", encoder, embedded.pooler_output, model.logit_scale, classes, prepare)


class _TransformersEncoder(nn.Module):
    """The half of the library's CLIPModel for pictures."""

    def __init__(self, vision: nn.Module, projection: nn.Module) -> None:
        super().__init__()
        self.vision, self.projection = vision, projection

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, S, S) to (B, F)."""
        features: Tensor = self.projection(self.vision(pixel_values=pictures).pooler_output)
        return features


def load_open_clip(
    architecture: str, weights: Path | None, classes: Sequence[str], *, prompt: str = PROMPT
) -> FrozenClassifier:
    """CLIP of the library open_clip."""
    texts, what = _texts(classes, prompt), f"weights of open_clip:{architecture}"
    if weights is None or not Path(weights).is_file():
        raise DetectorError.of(what, "a file", "none" if weights is None else f"no file {weights}", "name one")
    try:
        import open_clip
    except ImportError as error:
        raise DetectorError.of("classifier", "the package open_clip", str(error), install("clip")) from error
    if architecture not in open_clip.list_models():
        do = "see open_clip.list_models()"
        raise DetectorError.of("classifier", "an architecture of open_clip", repr(architecture), do)
    try:
        model = open_clip.create_model(
            architecture, pretrained=str(weights), pretrained_text=False, require_pretrained=True, weights_only=True
        )
        tokenizer = open_clip.get_tokenizer(architecture)
    except Exception as error:  # what the library raises has no common base
        do = "pass weights of this architecture"
        raise DetectorError.of(what, "weights that the library reads", one_line(error), do) from error
    check_finite(model.state_dict(), what)
    model.eval()
    with torch.no_grad():
        embedded = model.encode_text(tokenizer(texts))
    kept = open_clip.get_model_preprocess_cfg(model)
    if kept["resize_mode"] != "shortest":
        raise DetectorError.of(what, "pictures scaled to the shorter side", kept["resize_mode"], "take another")
    size = kept["size"] if isinstance(kept["size"], int) else kept["size"][0]
    mean, deviation = tuple(kept["mean"]), tuple(kept["std"])
    prepare = Preparation(size=size, mean=mean, deviation=deviation, mode=kept["interpolation"])
    return _classifier(f"open_clip:{architecture}", model.visual, embedded, model.logit_scale, classes, prepare)


def _texts(classes: Sequence[str], prompt: str) -> list[str]:
    """The text of each class."""
    if "{}" not in prompt:
        raise InvalidValueError.of("prompt", "a text with {} in the place of the class", repr(prompt), PROMPT)
    return [prompt.replace("{}", name) for name in check_classes(classes)]


def _classifier(
    name: str, encoder: nn.Module, texts: Tensor, log_scale: Tensor, classes: Sequence[str], prepare: Preparation
) -> FrozenClassifier:
    """The classifier of an encoder of pictures and the features of texts."""
    model = ZeroShot(encoder, normalize(texts, dim=1), temperature=float(log_scale.detach().exp()))
    keep_gradients_right(model)
    return FrozenClassifier(name, model, classes, prepare)
