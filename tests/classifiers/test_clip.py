"""The adapters to CLIP against the libraries themselves, with small networks of random weights."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks.classifiers.clip import load_clip
from attacks.classifiers.registry import load_classifier
from attacks.detectors.catalogue import DetectorError
from mi_splat.errors import InvalidValueError

CLASSES = ("car", "red bird", "tv")
LETTERS = "abcdefghijklmnopqrstuvwxyz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Model, image processor and a tokenizer of letters, as `save_pretrained` writes them."""
    library = pytest.importorskip("transformers")
    torch.set_num_threads(1)
    path = tmp_path_factory.mktemp("clip")
    words = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
    (path / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (path / "merges.txt").write_text("#version: 0.2\n")
    small = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    ends = {"bos_token_id": len(words) - 2, "eos_token_id": len(words) - 1, "pad_token_id": len(words) - 1}
    config = library.CLIPConfig(
        text_config={**small, **ends, "vocab_size": len(words)},
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        library.CLIPModel(config).save_pretrained(path)
    processor = library.CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32})
    processor.save_pretrained(path)
    library.CLIPTokenizer.from_pretrained(path).save_pretrained(path)
    return path


def pictures() -> Tensor:
    """Two of 8 bits, wider than high."""
    noise = torch.rand(2, 40, 60, 3, generator=torch.Generator().manual_seed(5))
    return (noise * 255).round() / 255


def test_scores_are_those_of_the_library(folder: Path) -> None:
    import transformers as library

    classifier = load_classifier("clip", weights=folder, classes=CLASSES)
    model: Any = library.CLIPModel.from_pretrained(folder).eval()
    images = [np.asarray((image * 255).byte()) for image in pictures()]
    tokens = library.AutoTokenizer.from_pretrained(folder)([f"a photo of a {name}" for name in CLASSES], padding=True)
    pixels = library.CLIPImageProcessor.from_pretrained(folder)(images, return_tensors="pt")["pixel_values"]
    with torch.no_grad():
        wanted = model(**{key: torch.tensor(value) for key, value in tokens.items()}, pixel_values=pixels)
        scores = classifier.scores(pictures())
    assert classifier.classes == CLASSES
    assert torch.allclose(scores, wanted.logits_per_image, atol=0.05)  # the library rounds what it has scaled to 8 bits
    assert scores.std() > 0.2
    bare = load_clip(folder, CLASSES, prompt="{}")
    assert bare.fingerprint != classifier.fingerprint
    (gradient,) = torch.autograd.grad(bare.scores(image := pictures().requires_grad_(True))[:, 0].sum(), image)
    assert float(gradient.abs().max()) > 0


def test_what_clip_refuses(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="classes of clip: expected a list"):
        load_classifier("clip", weights=folder)
    with pytest.raises(InvalidValueError, match="prompt: expected a text with"):
        load_clip(folder, CLASSES, prompt="a photo")
    with pytest.raises(DetectorError, match=r"weights of clip: expected a folder of .*, got none"):
        load_clip(None, CLASSES)
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(DetectorError, match=r"no preprocessor_config\.json"):
        load_clip(tmp_path, CLASSES)
