"""DAGGER against a detector and a reader of text at once:
`python -m scenes.recipes.attack_reader --out out/reader`.

The sign shall be reported as another class, no longer as a stop sign, and RapidOCR
shall not read STOP on it. For the gradient the recognition network of RapidOCR runs in
torch, on the word as the reader finds it on the clean splat; what counts is the whole
reader. The weight of its loss was chosen out of 1, 3 and 10 with seed 0 and the scene's
cameras.
"""

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from attacks.dagger.attack import attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.views import FixedViews
from attacks.detectors import load_detector
from attacks.detectors.base import Candidates, Detections, Detector
from attacks.detectors.graphs.graph import fields, parts
from attacks.figures.rate import Rate
from attacks.objectives.base import Target
from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import Hide
from attacks.observe.observations import report_cells, verdict_cells
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, frame_of, write_rows
from attacks.observe.views import image_change
from attacks.studies.attack import AttackScene, attack_scene, cameras_in
from mi_splat.cameras.camera import Camera

SCENE = Path("scenes/stop_sign.xml")
OBJECT = "stop_sign"
WORD = "STOP"
HEIGHT = 48
WIDTH = 320
"""Pixels of the images of words that the network takes; narrower ones end in
zeros.
"""
UNREAD = Hide(confidence=0.5, iou=0.5)
"""Aim of the reader's own rows."""
_TYPES = {1: np.float32, 6: np.int32, 7: np.int64, 9: np.bool_}


def integers(values: list[Any]) -> list[int]:
    """Whole numbers of a field, packed or not; those of 64 bits have a sign."""
    found = []
    for value in values:
        found += (
            [value]
            if isinstance(value, int)
            else [number for _, number in fields(b"".join(_tagged(value)))]
        )
    return [number - (1 << 64) if number >> 63 else number for number in found]


def _tagged(packed: memoryview) -> Iterator[bytes]:
    """Packed numbers, each as a field of its own."""
    start = 0
    for at, byte in enumerate(packed):
        if byte < 128:
            yield b"\x08" + bytes(packed[start : at + 1])
            start = at + 1


def tensor(message: memoryview) -> Tensor:
    """A TensorProto of ONNX with its numbers in raw form."""
    kind = _TYPES[next(parts(message, 2))]
    shape = integers([*parts(message, 1)])
    return torch.from_numpy(
        np.frombuffer(next(parts(message, 9), b""), kind).reshape(shape).copy()
    )


def attribute(message: memoryview) -> Any:
    """The value of an AttributeProto: a number, whole numbers or a tensor."""
    kind = next(parts(message, 20))
    if kind == 1:
        return float(np.frombuffer(next(parts(message, 2)), np.float32)[0])
    if kind == 4:
        return tensor(next(parts(message, 5)))
    numbers = integers([*parts(message, 3 if kind == 2 else 8)])
    if kind == 2:
        return numbers[0]
    return numbers


def _convolve(
    of: dict[str, Any], image: Tensor, kernel: Tensor, bias: Tensor | None = None
) -> Tensor:
    top, left, bottom, right = of.get("pads", (0, 0, 0, 0))
    image = functional.pad(image, (left, right, top, bottom))
    return functional.conv2d(
        image, kernel, bias, of["strides"], 0, of["dilations"], of["group"]
    )


def _slice(
    of: dict[str, Any],
    value: Tensor,
    starts: Tensor,
    ends: Tensor,
    axes: Tensor,
    *steps: Tensor,
) -> Tensor:
    for start, end, axis in zip(
        starts.tolist(), ends.tolist(), axes.tolist(), strict=True
    ):
        value = value[(slice(None),) * axis + (slice(start, end),)]
    return value


def _reshape(of: dict[str, Any], value: Tensor, shape: Tensor) -> Tensor:
    return value.reshape(
        [
            value.shape[axis] if size == 0 else size
            for axis, size in enumerate(shape.tolist())
        ]
    )


OPERATIONS: dict[str, Any] = {
    "Add": lambda of, one, other: one + other,
    "AveragePool": lambda of, image: functional.avg_pool2d(
        image, of["kernel_shape"], of["strides"]
    ),
    "BatchNormalization": lambda of, image, scale, offset, mean, variance: (
        functional.batch_norm(image, mean, variance, scale, offset, eps=of["epsilon"])
    ),
    "Cast": lambda of, value: value.to(
        torch.from_numpy(np.zeros(1, _TYPES[of["to"]])).dtype
    ),
    "Clip": lambda of, value, low, high: value.clamp(low, high),
    "Concat": lambda of, *values: torch.cat(values, of["axis"]),
    "Constant": lambda of: of["value"],
    "Conv": _convolve,
    "Div": lambda of, one, other: one / other,
    "GlobalAveragePool": lambda of, image: image.mean((2, 3), keepdim=True),
    "HardSigmoid": lambda of, value: (of["alpha"] * value + of["beta"]).clamp(0, 1),
    "MatMul": lambda of, one, other: one @ other,
    "Mul": lambda of, one, other: one * other,
    "Pow": lambda of, one, other: one**other,
    "ReduceMean": lambda of, value: value.mean(
        of["axes"], keepdim=bool(of.get("keepdims", 1))
    ),
    "Relu": lambda of, value: value.relu(),
    "Reshape": _reshape,
    "Shape": lambda of, value: torch.tensor(value.shape),
    "Sigmoid": lambda of, value: value.sigmoid(),
    "Slice": _slice,
    "Softmax": lambda of, value: value.softmax(of["axis"]),
    "Sqrt": lambda of, value: value.sqrt(),
    "Squeeze": lambda of, value: value.squeeze(tuple(of["axes"])),
    "Sub": lambda of, one, other: one - other,
    "Transpose": lambda of, value: value.permute(of["perm"]),
}
"""What the operations of the network are in torch, from their attributes and inputs."""


class Recogniser:
    """RapidOCR's recognition network in torch: images of words to the probability
    that a word is read.
    """

    def __init__(self, reader: Detector) -> None:
        import rapidocr_onnxruntime as package

        (self.path,) = (Path(package.__file__).parent / "models").glob(
            "*_rec_infer.onnx"
        )
        alphabet = reader.model._engine.text_rec.postprocess_op.character  # type: ignore[attr-defined]
        graph = next(parts(self.path.read_bytes(), 7))
        self.nodes = list[tuple[str, list[str], str, dict[str, Any]]]()
        for node in parts(graph, 1):
            op = bytes(next(parts(node, 4))).decode()
            inputs, (output, *_) = (
                [bytes(name).decode() for name in parts(node, field)]
                for field in (1, 2)
            )
            named = {bytes(next(parts(of, 1))).decode(): of for of in parts(node, 5)}
            self.nodes.append(
                (
                    op,
                    inputs,
                    output,
                    {name: attribute(of) for name, of in named.items()},
                )
            )
        self.input = bytes(next(parts(next(parts(graph, 11)), 1))).decode()
        self.columns = [
            [alphabet.index(case) for case in (letter, letter.lower())]
            for letter in WORD
        ]

    def __call__(self, words: Tensor) -> Tensor:
        """(B, T, characters) probabilities of images (B, 3, 48, 320), blue first, in
        [-1, 1].
        """
        values = {self.input: words}
        for op, inputs, output, settings in self.nodes:
            values[output] = OPERATIONS[op](
                settings, *(values[name] for name in inputs)
            )
        return values[output]

    def certainty(self, words: Tensor) -> Tensor:
        """(B,) product over the letters of the word of each one's highest probability,
        in either case.
        """
        return self(words)[:, :, self.columns].sum(-1).amax(1).prod(1)


def word_picture(image: Tensor, corners: Tensor) -> Tensor:
    """(3, 48, 320) the word between four corners of an image (H, W, 3), as the network
    takes it.
    """
    sides = corners.roll(-1, 0) - corners
    across, down = (
        max(float(sides[n].norm()), float(sides[n + 2].norm())) for n in (0, 1)
    )
    width = min(math.ceil(HEIGHT * across / down), WIDTH)
    u = ((torch.arange(width) + 0.5) / width)[None, :, None]
    v = ((torch.arange(HEIGHT) + 0.5) / HEIGHT)[:, None, None]
    top = corners[0] + u * (corners[1] - corners[0])
    bottom = corners[3] + u * (corners[2] - corners[3])
    at = top + v * (bottom - top)
    grid = 2 * at / torch.tensor([image.shape[1], image.shape[0]]) - 1
    bgr = image.permute(2, 0, 1).flip(0)[None]
    word = functional.grid_sample(
        bgr, grid[None].to(bgr), padding_mode="border", align_corners=False
    )[0]
    return functional.pad(2 * word - 1, (0, WIDTH - width))


class Both:
    """A detector and the reader: what either reports; the reader's candidate is the
    last one.
    """

    def __init__(
        self,
        detector: Detector,
        reader: Detector,
        recogniser: Recogniser,
        corners: Tensor,
    ) -> None:
        self.detector = detector
        self.reader = reader
        self.recogniser = recogniser
        self.corners = corners
        self.name = f"{detector.name} and {reader.name}"
        self.classes = detector.classes
        self.fingerprint = detector.fingerprint
        self.min_confidence = detector.min_confidence

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Those of the detector, and one whose score for a stop sign is the certainty
        of the word.
        """
        found = []
        for image, seen in zip(images, self.detector.candidates(images), strict=True):
            (certainty,) = self.recogniser.certainty(
                word_picture(image, self.corners)[None]
            )
            scores = certainty * functional.one_hot(
                torch.tensor(self.classes.index("stop sign")), len(self.classes)
            )
            box = torch.cat([self.corners.amin(0), self.corners.amax(0)])
            boxes = torch.cat([seen.boxes, box.expand(1, len(self.classes), 4)])
            found.append(Candidates(boxes, torch.cat([seen.scores, scores[None]])))
        return found

    def detect(self, images: Tensor) -> list[Detections]:
        """What both report."""
        pairs = zip(
            self.detector.detect(images), self.reader.detect(images), strict=True
        )
        return [
            Detections(
                torch.cat([one.boxes, other.boxes.to(one.boxes)]),
                torch.cat([one.scores, other.scores.to(one.scores)]),
                (*one.labels, *other.labels),
            )
            for one, other in pairs
        ]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RelabelUnread(Relabel):
    """The strict aim of DAGGER, and the word is not read."""

    weight: float

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        certainty = candidates.scores[-1].sum().clamp(max=1 - 1e-6)
        seen = Candidates(candidates.boxes[:-1], candidates.scores[:-1])
        return Relabel.__call__(self, seen, target) - self.weight * torch.log1p(
            -certainty
        )


def word_corners(reader: Detector, scene: AttackScene, camera: Camera) -> Tensor | None:
    """(4, 2) pixels of the corners of the word on the clean splat; None where it is not
    read.
    """
    picture = (
        (scene.renderer("")(scene.scene, camera).detach().clamp(0, 1) * 255)
        .round()
        .to(torch.uint8)
    )
    (readings,) = reader.model(picture[None])  # type: ignore[attr-defined]
    found = [
        corners
        for corners, text, score in readings
        if text.strip().upper() == WORD and score >= 0.5
    ]
    if found:
        return torch.tensor(found[0], dtype=torch.float32)
    return None


def attacked(
    scene: AttackScene,
    camera: Camera,
    target: str,
    seed: int,
    weight: float,
    of: tuple[Detector, Detector, Recogniser],
) -> Iterator[dict[str, Any]]:
    """What both, and each of them, report; nothing where the word is not read on the
    clean splat.
    """
    corners = word_corners(of[1], scene, camera)
    if corners is None:
        return
    search = {"step_factor": 10.0, "momentum": 0.2, "schedule": "linear"}
    config = DaggerConfig(**search, noise_draws=1, seed=seed, random_start=seed > 0)  # type: ignore[arg-type]
    aim = RelabelUnread(
        label=target, strict=True, near=0.8, spread=1.0, confidence=0.5, weight=weight
    )
    views = FixedViews(
        scene.scene, scene.objects[OBJECT], [camera], render=scene.renderer("")
    )
    (judged,) = attack_views(
        views, both := Both(*of, corners), aim, config=config
    ).views
    wanted = judged.target
    for splat, seen in (
        (CLEAN, judged.clean),
        (ATTACKED, judged.attacked),
        *((NOISE, noisy) for noisy in judged.controls.values()),
    ):
        if splat == CLEAN:
            on_object = None
        else:
            on_object = psnr_of(judged.clean.image, seen.image, judged.view.weight)
        for detector in (both, *of[:2]):
            (found,) = detector.detect(seen.image[None])
            verdict = verdict_cells(
                (UNREAD if detector is of[1] else aim).verdict(found, wanted)
            )
            cells = report_cells(
                found, wanted.box, original=wanted.original, target=target
            )
            yield {
                "splat": splat,
                "detector": detector.name,
                **cells,
                **verdict,
                "object_psnr": on_object,
            }


def psnr_of(clean: Tensor, image: Tensor, weight: Tensor) -> float | None:
    """PSNR on the object, dB."""
    return image_change([clean], [image], [weight]).psnr_object


def main() -> None:
    """Attack from each camera for each target; a table, and rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--detector", default="yolov8n_small")
    parser.add_argument(
        "--cameras", type=Path, default=Path("scenes/cameras/stop_sign.json")
    )
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--targets", nargs="+", default=["tv", "train", "bird"])
    parser.add_argument("--weights", type=float, nargs="+", default=[3.0])
    options = parser.parse_args()
    scene = attack_scene(SCENE)
    reader = load_detector("rapidocr")
    of = load_detector(options.detector), reader, Recogniser(reader)
    cameras = list(
        (
            cameras_in(options.cameras) if options.cameras.is_file() else scene.cameras
        ).values()
    )
    options.out.mkdir(parents=True, exist_ok=True)
    lines: list[dict[str, Any]] = []
    for weight in options.weights:
        for target in options.targets:
            ids = {
                "attack": f"{target}, weight {weight:g}",
                "sources": options.detector,
                "seed": options.seed,
            }
            for number, camera in enumerate(cameras[:: options.every]):
                found = list(attacked(scene, camera, target, options.seed, weight, of))
                lines += [
                    {**ids, "view": number * options.every, **row} for row in found
                ]
                told = [
                    (row["splat"], row["detector"], row["success"])
                    for row in found
                    if row["splat"] != CLEAN
                ]
                sys.stdout.write(f"{number} {ids['attack']} {told}\n")
                sys.stdout.flush()
            write_rows(frame_of(lines), options.out / "rows.csv.xz")
    rows = frame_of(lines)
    for (attack, splat, name), some in rows.group_by(
        "attack", "splat", "detector", maintain_order=True
    ):
        rate = Rate(successes=int(some["success"].sum()), total=len(some))
        sys.stdout.write(f"{attack}, {splat}, {name}: {rate.short(interval=True)}\n")


if __name__ == "__main__":
    main()
