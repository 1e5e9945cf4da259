"""The small network of images and texts: what it takes, what it names, how it is trained, and its card."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks.classifiers.base import Classifier
from attacks.classifiers.catalogue import IMAGE_TEXT_WEIGHTS as WEIGHTS
from attacks.classifiers.image_text import PREPARATION, ImageText, load_network
from attacks.classifiers.image_text_captions import (
    CLASSES,
    OBJECTS,
    PAINTS,
    SURROUNDINGS,
    WORDS,
    Facts,
    caption_text,
    draw_caption,
    tokens,
    true_of,
)
from attacks.classifiers.image_text_evaluation import card
from attacks.classifiers.image_text_pictures import ToldPicture, told_pictures, told_scene
from attacks.classifiers.image_text_training import ImageTextTraining, contrastive_loss, train, write
from attacks.classifiers.registry import load_classifier
from mi_splat.errors import InvalidValueError

RED_CAR = Facts(objects=OBJECTS["car"], paints=("red",), surroundings=SURROUNDINGS["asphalt"])
EMPTY = Facts(objects=("empty",), surroundings=SURROUNDINGS["park"], lights=("under a low sun",))


@pytest.fixture(scope="module")
def shipped() -> ImageText:
    classifier = load_classifier("image_text")
    assert isinstance(classifier, ImageText)
    return classifier


@pytest.mark.parametrize("number", [2, 11])
def test_it_names_fresh_pictures_of_objects_that_were_held_out(shipped: ImageText, number: int) -> None:
    (picture,) = told_pictures("held-out", number, 1)
    with torch.no_grad():
        scores = shipped.scores(picture.image[None].float() / 255)
    assert shipped.classes[int(scores.argmax())] == picture.facts.objects[0]


def test_scores_are_differentiable_at_any_size_and_do_not_hang_on_the_others(shipped: ImageText) -> None:
    assert isinstance(shipped, Classifier)
    images = torch.rand((2, 80, 120, 3), generator=torch.Generator().manual_seed(0)).requires_grad_()
    scores = shipped.scores(images)
    assert scores.shape == (2, len(CLASSES))
    (gradient,) = torch.autograd.grad(scores[0, 0], images)
    assert gradient[0, :, 20:100].abs().sum() > 0
    assert gradient[1].abs().max() == 0
    assert gradient[0, :, :17].abs().max() == gradient[0, :, 103:].abs().max() == 0  # what is cut off
    torch.testing.assert_close(shipped.scores(images[1:]), scores[1:])
    with pytest.raises(InvalidValueError, match="sRGB in"):
        shipped.scores(255 * images)


def test_classes_are_any_words_that_it_knows_and_part_of_its_fingerprint(shipped: ImageText) -> None:
    painted = ImageText(["red car", "Blue car", "empty road"], templates=["{}"])
    assert painted.classes == ("red car", "Blue car", "empty road")
    assert painted.scores(torch.full((1, 64, 64, 3), 0.5)).shape == (1, 3)
    assert len({painted.fingerprint, shipped.fingerprint, ImageText(["car"]).fingerprint}) == 3
    with pytest.raises(InvalidValueError, match=r"class .green elefant.*did you mean elephant"):
        ImageText(["car", "green elefant"])
    for classes in ([], "car", ["car", "car"]):
        with pytest.raises(InvalidValueError, match="names, each once"):
            ImageText(classes)
    with pytest.raises(InvalidValueError, match="texts with"):
        ImageText(templates=["a photo"])


def test_a_damaged_or_strange_file_is_refused(tmp_path: Path) -> None:
    whole, path = WEIGHTS.read_bytes(), tmp_path / "weights.safetensors"
    for content in (whole[: len(whole) // 2], b"", whole.replace(b"elephant", b"elephast", 1)):
        path.write_bytes(content)
        with pytest.raises(InvalidValueError, match="restore the file"):
            ImageText(weights=path)
    with pytest.raises(InvalidValueError, match="restore the file"):
        ImageText(weights=tmp_path / "nothing.safetensors")


def test_captions_say_what_is_true_and_no_more() -> None:
    rng = np.random.default_rng(0)
    for facts in (RED_CAR, EMPTY):
        captions = [draw_caption(facts, rng) for _ in range(30)]
        assert true_of(captions, [facts]).all()
        assert all(set(tokens(caption_text(caption))) <= set(range(len(WORDS))) for caption in captions)
    vehicle, blue = ("vehicle", "", "road", "", ""), ("car", "blue", "", "", "")
    assert true_of([vehicle, blue], [RED_CAR, replace(RED_CAR, paints=("blue",)), EMPTY]).tolist() == [
        [True, True, False],
        [False, True, False],
    ]
    assert caption_text(("car", "orange", "grass", "from above", "")) == "a photo of an orange car on grass from above"
    assert caption_text(("empty", "", "park", "", "under a low sun")) == "a photo of an empty park under a low sun"


def test_the_loss_is_that_of_clip_where_each_caption_has_one_picture() -> None:
    texts, images = torch.nn.functional.normalize(torch.randn(2, 5, 8, dtype=torch.float64), dim=-1)
    logits = 7 * texts @ images.T
    each = torch.arange(5)
    clip = (torch.nn.functional.cross_entropy(logits, each) + torch.nn.functional.cross_entropy(logits.T, each)) / 2
    temperature = torch.tensor(7.0, dtype=torch.float64)
    torch.testing.assert_close(contrastive_loss(texts, images, torch.eye(5, dtype=torch.bool), temperature), clip)


def test_splits_share_no_object_and_scenes_are_functions_of_their_number() -> None:
    first, again = told_scene("train", 13), told_scene("train", 13)
    assert first[1] == again[1]
    np.testing.assert_array_equal(first[0].assets[0].vertices, again[0].assets[0].vertices)
    other = told_scene("held-out", 13)
    assert other[1].objects == first[1].objects
    assert other[0].assets[0].vertices.shape != first[0].assets[0].vertices.shape or not np.allclose(
        other[0].assets[0].vertices, first[0].assets[0].vertices
    )


def test_a_training_learns_repeats_and_its_file_loads(tmp_path: Path) -> None:
    paints = ("red", "green", "blue")
    pictures = [
        ToldPicture((torch.tensor(PAINTS[paint]) * 255).byte().expand(96, 96, 3), replace(RED_CAR, paints=(paint,)), i)
        for i, paint in enumerate(paints * 2)
    ]
    losses: list[float] = []
    config = ImageTextTraining(epochs=2, batch=6)
    network = train(pictures, config, on_epoch=lambda epoch, loss: losses.append(loss))
    again = train(pictures, config)
    path = tmp_path / "weights.safetensors"
    write(network, path)
    assert len(losses) == 2
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True))
    loaded = load_network(path)
    torch.testing.assert_close(loaded.words.weight, network.words.weight.half().float())
    image = PREPARATION(torch.rand(1, 96, 96, 3))
    torch.testing.assert_close(loaded(image), network(image), atol=0.02, rtol=0)


def test_the_card_and_its_figures_are_of_the_shipped_weights(shipped: ImageText) -> None:
    document = json.loads(WEIGHTS.with_suffix(".json").read_text())
    assert document["fingerprint"] == shipped.fingerprint
    assert WEIGHTS.with_suffix(".md").read_text() == card(document)
    assert document["sets"]["path traced"]["objects"]["classes"] == len(CLASSES) >= 10
    assert WEIGHTS.stat().st_size < 2_000_000
