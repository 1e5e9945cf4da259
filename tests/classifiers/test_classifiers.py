"""Classifiers against their libraries, with random weights from files."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch import nn
from torchvision.models import SqueezeNet1_1_Weights, squeezenet1_1

from attacks.classifiers import prototypes
from attacks.classifiers.base import Classifier
from attacks.classifiers.frozen import Preparation, classified
from attacks.classifiers.prototypes import LENGTH, VECTORS, load_prototypes
from attacks.classifiers.registry import load_classifier
from attacks.detectors.catalogue import DetectorError, weights_of
from mi_splat.capture.objects import OBJECTS
from mi_splat.errors import InvalidValueError
from mi_splat.io.noted_tensors import NOTES
from scenes.recipes.prototypes import Recipe, pictures_of, save_prototypes
from tests.classifiers.made import CLASSES, toy_classifier

pytestmark = pytest.mark.shipped


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def noise(
    *shape: int, seed: int = 0, dtype: torch.dtype = torch.float32
) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_gradients_are_those_of_finite_differences() -> None:
    classifier = toy_classifier()
    assert isinstance(classifier, Classifier)
    pictures = noise(1, 30, 40, 3, dtype=torch.float64).requires_grad_(True)
    (gradient,) = torch.autograd.grad(
        torch.log_softmax(classifier.scores(pictures), 1)[0, 1], pictures
    )
    for seed in range(3):
        step = 1e-5 * (noise(1, 30, 40, 3, seed=9 + seed, dtype=torch.float64) - 0.5)
        with torch.no_grad():
            high, low = (
                torch.log_softmax(
                    classifier.scores((pictures + sign * step).clamp(0, 1)), 1
                )[0, 1]
                for sign in (1, -1)
            )
        assert float(high - low) == pytest.approx(
            2 * float((gradient * step).sum()), rel=1e-3
        )


@pytest.mark.parametrize("size", [(300, 280), (224, 224), (90, 140)])
def test_pictures_are_prepared_as_the_library_does(
    size: tuple[int, int], tmp_path: Path
) -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        model = squeezenet1_1(weights=None).eval()
    path = tmp_path / "random.pth"
    torch.save(model.state_dict(), path)
    classifier = load_classifier("torchvision:squeezenet1_1", weights=path)
    assert len(classifier.classes) == len(set(classifier.classes)) == 1000
    pictures = noise(1, *size, 3)
    with torch.no_grad():
        expected = model(
            SqueezeNet1_1_Weights.IMAGENET1K_V1.transforms()(
                pictures.permute(0, 3, 1, 2)
            )
        )
        assert torch.allclose(classifier.scores(pictures), expected, atol=1e-5)


def test_a_network_of_other_classes_and_what_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "two.pth"
    torch.save(squeezenet1_1(weights=None, num_classes=2).state_dict(), path)
    two = load_classifier(
        "torchvision:squeezenet1_1", weights=path, classes=["car", "bird"]
    )
    assert two.scores(noise(1, 64, 64, 3)).shape == (1, 2)
    assert (
        two.fingerprint
        != load_classifier(
            "torchvision:squeezenet1_1", weights=path, classes=["tv", "bird"]
        ).fingerprint
    )
    with pytest.raises(DetectorError, match="2 of another shape"):
        load_classifier("torchvision:squeezenet1_1", weights=path)
    with pytest.raises(InvalidValueError, match="did you mean squeezenet1_1"):
        load_classifier("torchvision:squeezenet11", weights=path)
    for name in ("torchvision", "prototypes:x", "rubbish"):
        with pytest.raises(InvalidValueError, match="classifier"):
            load_classifier(name)


def test_rows_of_what_is_seen() -> None:
    classifier = toy_classifier()
    rows = classified(classifier, [noise(30, 40, 3, seed=i) for i in range(4)], "bird")
    assert [row["view"] for row in rows] == [0, 1, 2, 3]
    for row in rows:
        assert row["classifier"] == "toy"
        assert row["top1"] in CLASSES
        assert row["right"] == (row["top1"] == "bird")
        assert row["confidence"] > 0.5 or not row["right"] or row["confidence"] > 1 / 3
    with pytest.raises(
        InvalidValueError,
        match=r"label of toy: expected one of car, bird, tv, got 'birds'.*bird\?",
    ):
        classified(classifier, [], "birds")


def test_prototypes_are_mean_directions_less_their_mean(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = nn.Sequential(
        nn.Conv2d(3, 4, 7, 7), nn.Flatten(), nn.Linear(4 * 32 * 32, LENGTH)
    ).eval()
    pictures = {
        name: noise(2, 40, 40, 3, seed=i) * (0.4 + 0.3 * i)
        for i, name in enumerate(CLASSES)
    }
    path = tmp_path / "p.safetensors"
    save_prototypes(
        {name: list(images) for name, images in pictures.items()},
        features,
        {"seeds": [1, 2]},
        path,
    )
    monkeypatch.setattr(prototypes, "load_features", lambda weights: features)
    classifier = load_prototypes(vectors=path)
    with torch.no_grad():
        units = [
            nn.functional.normalize(features(Preparation()(images)), dim=1).mean(0)
            for images in pictures.values()
        ]
        means = nn.functional.normalize(torch.stack(units), dim=1)
        mine = nn.functional.normalize(
            features(Preparation()(pictures["tv"][:1])), dim=1
        )
        cosines = nn.functional.cosine_similarity(
            mine - means.mean(0), means - means.mean(0)
        )
    assert torch.allclose(
        classifier.scores(pictures["tv"][:1])[0], 20 * cosines, atol=1e-3
    )
    fewer = load_prototypes(vectors=path, classes=["tv", "car"])
    both = classifier.scores(pictures["tv"])[:, [2, 0]]
    assert torch.allclose(fewer.scores(pictures["tv"]), both, atol=1e-5)
    with pytest.raises(
        InvalidValueError, match=r"class: expected one of car, bird, tv"
    ):
        load_prototypes(vectors=path, classes=["zebra"])


def test_features_that_are_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(
        DetectorError, match=r"nothing there; mi-splat detectors --get prototypes"
    ):
        load_classifier("prototypes")
    weights_of("prototypes").parent.mkdir(parents=True)
    weights_of("prototypes").write_bytes(b"abcd")
    with pytest.raises(DetectorError, match="readable"):
        load_classifier("prototypes")


def test_shipped_prototypes_are_of_the_published_features() -> None:
    with safe_open(VECTORS, "pt") as file:
        notes = json.loads(file.metadata()[NOTES])
        directions = file.get_tensor("directions")
    assert notes["recipe"] == json.loads(json.dumps(asdict(Recipe()))), (
        "the recipe in scenes/recipes"
    )
    assert set(notes["classes"]) == set(OBJECTS)
    assert torch.allclose(directions.norm(dim=1), torch.ones(len(OBJECTS)), atol=1e-5)
    if not weights_of("prototypes").is_file():
        pytest.skip("the features are not here: mi-splat detectors --get prototypes")
    classifier = load_prototypes()
    assert classifier.scores(noise(1, 64, 64, 3)).shape == (1, len(OBJECTS))


@pytest.mark.slow
def test_the_recipe_of_prototypes_makes_pictures() -> None:
    recipe = Recipe(seeds=(3,), grounds=("road",), views=2, size=24, samples=1)
    assert [image.shape for image in pictures_of(recipe, "tv")] == [(24, 24, 3)] * 2
