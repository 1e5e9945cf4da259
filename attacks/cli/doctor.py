"""`mi-splat doctor`: check what `mi-splat dagger` needs on this machine, and say what
to do where it does not work.

A broken libLLVM, or a torch that does not fit its torchvision, can end the whole
process. So each check runs in a child process (`python -m attacks.cli.doctor CHECK`),
which prints what it says as a JSON text.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import json
import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from mi_splat.cameras.lens import Lens
from mi_splat.cli.console import import_at_once, progress, show_result
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import MiSplatError, install, nearest
from mi_splat.processes import python_command
from mi_splat.provenance import versions
from mi_splat.registry import brought_by_packages
from mi_splat.render.setup import llvm_hint

TIME_LIMIT = 300.0
"""Seconds that a child may take; the first kernels of a machine have to be compiled."""

EXAMPLES = ("doctor",)


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(JsonOptions):
    """Render one Gaussian, compute one gradient, load one detector; print what works,
    and how to fix what does not.

    Plug-ins of other packages are imported as well, and listed with their package.

    The exit status is 1 if something that `mi-splat dagger` needs does not work.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What one check found; "absent" is optional and not there."""

    name: str
    state: Literal["works", "fails", "absent"]
    detail: str
    advice: str = ""
    required: bool = False


@dataclass(frozen=True, slots=True)
class Check:
    """One check: `run` returns a detail, or raises; `advice` is given if it does not
    work.
    """

    name: str
    run: Callable[[], str]
    advice: str
    required: bool = True


def run(options: DoctorOptions) -> int:
    """Examine this machine."""
    with progress("checking", total=len(CHECKS)) as advance:
        findings = examine(lambda name: advance(f"checked {name}"))
    healthy = all(finding.state == "works" for finding in findings if finding.required)
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{finding.state:7}  {finding.name:{width}}  {finding.detail}")
        if finding.advice:
            lines.append(f"{'':7}  {'':{width}}  -> {finding.advice}")
    fine = "all that mi-splat needs works"
    broken = "something that mi-splat needs does not work; see the arrows"
    lines.append(fine if healthy else broken)
    document = {
        "healthy": healthy,
        "findings": [dataclasses.asdict(finding) for finding in findings],
    }
    show_result(document, *lines, as_json=options.json)
    if healthy:
        return 0
    return 1


def examine(on_done: Callable[[str], None] = lambda name: None) -> list[Finding]:
    """All findings on this machine, in the order in which one thing needs the other."""
    packages = ", ".join(
        f"{package} {number}" for package, number in versions().items()
    )
    detail = f"{packages}; {platform.system()} {platform.machine()}"
    findings = [Finding(name="versions", state="works", detail=detail, required=True)]
    for check in CHECKS:
        findings.append(
            checked(check, python_command("attacks.cli.doctor", check.name))
        )
        on_done(check.name)
    for extra, modules in EXTRAS.items():
        missing = [
            module for module in modules if importlib.util.find_spec(module) is None
        ]
        if missing:
            detail = f"no {' and '.join(missing)}"
            advice = f"optional: {install(extra)}"
            findings.append(
                Finding(
                    name=f"extra {extra}", state="absent", detail=detail, advice=advice
                )
            )
        else:
            findings.append(
                Finding(name=f"extra {extra}", state="works", detail=", ".join(modules))
            )
    return [*findings, *map(_plug_in, brought_by_packages())]


def checked(check: Check, command: Sequence[str]) -> Finding:
    """The finding of a check that a command makes."""
    detail, reason = _answer(command)
    if detail is not None:
        return Finding(
            name=check.name, state="works", detail=detail, required=check.required
        )
    state: Literal["fails", "absent"] = "fails" if check.required else "absent"
    return Finding(
        name=check.name,
        state=state,
        detail=reason,
        advice=check.advice,
        required=check.required,
    )


def _plug_in(point: tuple[str, str, str]) -> Finding:
    """Whether what another package brings is there; a child imports it, for it may do
    anything.
    """
    group, name, origin = point
    advice = ""
    if group not in REGISTRIES:
        advice = (
            "no command looks there;"
            f" {nearest(group, REGISTRIES, 'see docs/plug-ins.md')}"
        )
    else:
        advice = _answer(python_command("attacks.cli.doctor", f"{group}/{name}"))[1]
    state: Literal["works", "fails"] = "fails" if advice else "works"
    return Finding(
        name=f"plug-in {name}", state=state, detail=f"{origin} ({group})", advice=advice
    )


def _answer(command: Sequence[str]) -> tuple[str | None, str]:
    """What a child said, or None and why: a signal that ended it, or the last line of
    its stderr.
    """
    try:
        child = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TIME_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None, f"no answer after {TIME_LIMIT:.0f} s"
    said = [line for line in child.stdout.splitlines() if line.startswith(b'"')]
    if said:
        return str(json.loads(said[0])), ""
    lines = [
        line.strip()
        for line in child.stderr.decode(errors="replace").splitlines()
        if line.strip()
    ]
    if child.returncode < 0:
        return None, " ".join(
            [
                f"the process was ended by {signal.Signals(-child.returncode).name}",
                *lines[:1],
            ]
        )
    return None, (
        re.sub(r"^(mi_splat|attacks)[\w.]*: ", "", lines[-1])
        if lines
        else f"exit status {child.returncode}"
    )


def _llvm() -> str:
    from mi_splat.render.setup import llvm_version, prepare_llvm
    from mi_splat.render.variant import use

    path = prepare_llvm()
    variant = use()
    if path is None:
        where = "left to Dr.Jit"
    else:
        where = f"version {llvm_version(path) or 'unknown'}, {path}"
    return f"{where}; {variant}"


def _one_gaussian(variant: str = "llvm_ad_rgb") -> str:
    """Render one bright Gaussian in front of black, and take the gradient by its
    colour.
    """
    import_at_once("torch")
    import torch

    from mi_splat.cameras.camera import Camera, look_at
    from mi_splat.render.renderer import Renderer, RenderSettings
    from mi_splat.scene import GaussianScene

    sh = torch.ones(1, 1, 3, requires_grad=True)
    scene = GaussianScene(
        means=torch.zeros(1, 3),
        scales=torch.full((1, 3), 0.2),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.tensor([0.9]),
        sh=sh,
    )
    camera = Camera(
        to_world=look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        lens=Lens(focal=32.0, size=(32, 32)),
    )
    render = Renderer(RenderSettings(background=(0.0, 0.0, 0.0), variant=variant))
    image = render(scene.to("cuda" if variant.startswith("cuda") else "cpu"), camera)
    middle = float(image[16, 16].mean())
    corner = float(image[0, 0].mean())
    if not middle > corner + 0.3:
        raise ValueError(
            f"a bright Gaussian should show in the middle: {middle:.2f}, and"
            f" {corner:.2f} in a corner"
        )
    (gradient,) = torch.autograd.grad(image.sum(), sh)
    if not (bool(torch.isfinite(gradient).all()) and bool((gradient > 0).all())):
        raise ValueError(
            "the gradient of the image's sum by the colour should be positive:"
            f" {gradient.tolist()}"
        )
    return (
        f"the middle pixel is {middle:.2f}, the gradient by the colour"
        f" {float(gradient.mean()):.2f}"
    )


def _torch_pair() -> str:
    import_at_once("torchvision")
    import torch
    import torchvision

    boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 2.1]])
    kept = torchvision.ops.nms(boxes, torch.tensor([0.9, 0.8]), 0.5).tolist()
    if kept != [0]:
        raise ValueError(
            "torchvision's non-maximum suppression should keep the first of two boxes:"
            f" {kept}"
        )
    return f"torch {torch.__version__} and torchvision {torchvision.__version__}"


def _detector() -> str:
    import torch

    from attacks.detectors import load_detector

    detector = load_detector("fasterrcnn_small")
    (detections,) = detector.detect(torch.full((1, 64, 64, 3), 0.5))
    return (
        f"{detector.name}, {len(detector.classes)} classes, {len(detections)}"
        " detections in a grey image"
    )


def _cuda() -> str:
    import torch

    if not torch.cuda.is_available():
        raise MiSplatError(f"torch {torch.__version__} sees no GPU")
    return (
        f"{torch.cuda.get_device_name()}; of one Gaussian"
        f" {_one_gaussian('cuda_ad_rgb')}"
    )


CHECKS = (
    Check("LLVM", _llvm, f"{llvm_hint()}; or reinstall mitsuba and drjit"),
    Check("one Gaussian", _one_gaussian, f"if the process was ended, {llvm_hint()}"),
    Check(
        "torch pair",
        _torch_pair,
        "install both together, from one index: pip install --force-reinstall torch"
        " torchvision",
    ),
    Check(
        "one detector",
        _detector,
        "reinstall mi-splat; its weights are part of the package",
    ),
    Check(
        "CUDA",
        _cuda,
        "optional: all runs on the CPU; for a GPU install its driver and a torch built"
        " for CUDA",
        required=False,
    ),
)
EXTRAS = {
    "draco": ("DracoPy",),
    "ocr": ("rapidocr_onnxruntime",),
    "photos": ("pycolmap",),
    "report": ("jinja2", "matplotlib"),
    "tflite": ("tflite",),
    "usd": ("pxr",),
    "view": ("viser",),
    "yolo": ("ultralytics",),
}
REGISTRIES = {
    "mi_splat.attacks": ("attacks.optimisers", "OPTIMISERS"),
    "mi_splat.audit_rules": ("mi_splat.audit.rules", "ADDED"),
    "mi_splat.conditions": ("attacks.observe.conditions", "CONDITIONS"),
    "mi_splat.detectors": ("attacks.detectors.registry", "DETECTORS"),
    "mi_splat.formats": ("mi_splat.io.formats.format", "FORMATS"),
    "mi_splat.objectives": ("attacks.objectives", "OBJECTIVES"),
    "mi_splat.poisons": ("attacks.poisons.specs", "POISONS"),
    "mi_splat.projections": ("mi_splat.cameras.lens", "PROJECTIONS"),
    "mi_splat.renderers": ("mi_splat.comparison.methods", "RENDERERS"),
    "mi_splat.threats": ("attacks.threats", "THREATS"),
    "mi_splat.strategies": ("mi_splat.training.strategies", "STRATEGIES"),
}
"""Who reads each group of entry points."""


if __name__ == "__main__":  # in the child
    word = sys.argv[1]
    if "/" in word:
        point_group, point = word.split("/")
        module, registry = REGISTRIES[point_group]
        answer = type(
            getattr(importlib.import_module(module), registry).chosen(point)
        ).__name__
    else:
        answer = next(check for check in CHECKS if check.name == word).run()
    os.write(sys.stdout.fileno(), (json.dumps(answer) + "\n").encode())
