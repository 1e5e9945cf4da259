"""`mi-splat doctor`: check what `mi-splat dagger` needs on this machine, and say what to do where it does not work.

A broken libLLVM, or a torch that does not fit its torchvision, can end the whole process. So the checks run in a child
process (`python -m attacks.cli.doctor GROUP ...`), which prints what each check says as soon as it is done, one JSON
text a line. If it ends early, the first check without a line has failed; the signal or the last line of stderr says
why. The rest of that group needs what failed; another child looks at the groups that follow.
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
from functools import partial
from typing import TYPE_CHECKING, Literal

from mi_splat.cli.console import import_at_once, progress, show_result
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import MiSplatError, install, nearest
from mi_splat.llvm import llvm_hint
from mi_splat.processes import python_command
from mi_splat.provenance import versions
from mi_splat.registry import brought_by_packages

if TYPE_CHECKING:
    from torch import Tensor

State = Literal["works", "fails", "absent", "skipped"]
TIME_LIMIT = 300.0
"""Seconds that a child may take; the first kernels of a machine have to be compiled."""


EXAMPLES = ("doctor",)
SEE_ALSO = ("detectors",)


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(JsonOptions):
    """Render one Gaussian, take one gradient, load one detector; say what works and what to do about what does not.

    What other packages bring (plug-ins) is imported as well, and named with its package.

    The exit status is 1 if something that `mi-splat dagger` needs does not work.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What one check found.

    Attributes:
        name: What was checked.
        state: "works", "fails", "absent" (optional and not there) or "skipped" (an earlier check failed).
        detail: Versions, paths, or what went wrong.
        advice: What to do about it; empty where it works.
        required: Whether `mi-splat dagger` needs it.
    """

    name: str
    state: State
    detail: str
    advice: str
    required: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """One check: `run` returns a detail, or raises; `advice` is given if it does not work."""

    name: str
    run: Callable[[], str]
    advice: str
    required: bool = True


def run(options: DoctorOptions) -> int:
    """Examine this machine."""
    with progress("checking", total=len(GROUPS)) as advance:
        findings = examine(lambda group: advance(f"checked {group}"))
    healthy = all(finding.state == "works" for finding in findings if finding.required)
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{finding.state:7}  {finding.name:{width}}  {finding.detail}")
        if finding.advice:
            lines.append(f"{'':7}  {'':{width}}  -> {finding.advice}")
    fine, broken = "all that mi-splat needs works", "something that mi-splat needs does not work; see the arrows"
    lines.append(fine if healthy else broken)
    document = {"healthy": healthy, "findings": [dataclasses.asdict(finding) for finding in findings]}
    show_result(document, *lines, as_json=options.json)
    return 0 if healthy else 1


def examine(on_done: Callable[[str], None] = lambda name: None) -> list[Finding]:
    """All findings on this machine, in the order in which one thing needs the other."""
    packages = ", ".join(f"{package} {number}" for package, number in versions().items())
    detail = f"{packages}; {platform.system()} {platform.machine()}"
    findings = [Finding(name="versions", state="works", detail=detail, advice="", required=True)]
    findings += examine_groups(tuple(GROUPS), python_command("attacks.cli.doctor"), on_done)
    for extra, modules in EXTRAS.items():
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        state: State = "absent" if missing else "works"
        detail = f"no {' and '.join(missing)}" if missing else ", ".join(modules)
        advice = f"optional: {install(extra)}" if missing else ""
        findings.append(Finding(name=f"extra {extra}", state=state, detail=detail, advice=advice, required=False))
    return [*findings, *map(_plug_in, brought_by_packages())]


def _plug_in(point: tuple[str, str, str]) -> Finding:
    """Whether what another package brings is there; a child imports it, for it may do anything."""
    group, name, origin = point
    detail, advice = f"{origin} ({group})", ""
    if group not in REGISTRIES:
        advice = f"no command looks there; {nearest(group, REGISTRIES, 'see docs/plug-ins.md')}"
    elif not (done := _answers(python_command("attacks.cli.doctor", f"{group}/{name}")))[0]:
        advice = done[1]
    state: State = "fails" if advice else "works"
    return Finding(name=f"plug-in {name}", state=state, detail=detail, advice=advice, required=False)


def _brought(group: str, name: str) -> str:
    """The kind of what another package brings, which is imported."""
    module, registry = REGISTRIES[group]
    value = getattr(importlib.import_module(module), registry).chosen(name)
    return type(value).__name__


def examine_groups(
    groups: Sequence[str], command: Sequence[str], on_done: Callable[[str], None] = lambda name: None
) -> list[Finding]:
    """The findings of groups of probes."""
    findings: list[Finding] = []
    details: list[str] = []
    reason: str | None = None
    for number, group in enumerate(groups):
        if reason is None:
            details, reason = _answers([*command, *groups[number:]])
        probes = GROUPS[group]
        findings += [_finding(probe, k, details, reason) for k, probe in enumerate(probes)]
        if len(details) < len(probes):
            reason = None  # what follows needs another child
        details = details[len(probes) :]
        on_done(group)
    return findings


def _answers(command: Sequence[str]) -> tuple[list[str], str]:
    """What each probe of a child said, and why the child ended."""
    try:
        child = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIME_LIMIT, check=False)
        output, reason = child.stdout, _end_of(child.returncode, child.stderr.decode(errors="replace"))
    except subprocess.TimeoutExpired as error:
        output, reason = error.stdout or b"", f"no answer after {TIME_LIMIT:.0f} s"
    return [str(json.loads(line)) for line in output.splitlines() if line.startswith(b'"')], reason


def _finding(probe: Probe, number: int, details: Sequence[str], reason: str) -> Finding:
    """Of the probe with this number in a group of which so many have said something before the child ended."""
    state: State = "works"
    if number < len(details):
        detail, advice = details[number], ""
    elif number == len(details):
        state, detail, advice = "fails" if probe.required else "absent", reason, probe.advice
    else:
        state, detail, advice = "skipped", "needs what failed before", ""
    return Finding(name=probe.name, state=state, detail=detail, advice=advice, required=probe.required)


def _end_of(status: int, errors: str) -> str:
    """Why a child ended: the signal that killed it, or the last line of its stderr."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    if status < 0:
        return f"the process was ended by {signal.Signals(-status).name}" + (f" ({lines[0]})" if lines else "")
    return re.sub(r"^(mi_splat|attacks)[\w.]*: ", "", lines[-1]) if lines else f"exit status {status}"


def _llvm() -> str:
    from mi_splat.llvm import llvm_version, prepare_llvm

    path = prepare_llvm()
    return "left to Dr.Jit" if path is None else f"version {llvm_version(path) or 'unknown'}, {path}"


def _variant() -> str:
    from mi_splat.variant import use

    return use()


def _one_gaussian() -> str:
    return f"the middle pixel is {_middle(_render()):.2f}"


def _one_gradient() -> str:
    import torch

    sh = torch.zeros(1, 1, 3, requires_grad=True)
    picture = _render(sh)
    (gradient,) = torch.autograd.grad(picture.sum(), sh)
    if not (bool(torch.isfinite(gradient).all()) and bool((gradient > 0).all())):
        raise ValueError(
            f"the gradient of the picture's sum by the colour should be positive, and is {gradient.tolist()}"
        )
    return f"of the picture by the colour: {float(gradient.mean()):.2f}"


def _torch_pair() -> str:
    import_at_once("torchvision")
    import torch
    import torchvision

    boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 2.1]])
    kept = torchvision.ops.nms(boxes, torch.tensor([0.9, 0.8]), 0.5)
    if kept.tolist() != [0]:
        raise ValueError(
            f"torchvision's non-maximum suppression should keep the first of two boxes, and kept {kept.tolist()}"
        )
    return f"torch {torch.__version__} and torchvision {torchvision.__version__}"


def _detector() -> str:
    import torch

    from attacks.detectors import load_detector

    detector = load_detector("fasterrcnn_small")
    (detections,) = detector.detect(torch.full((1, 64, 64, 3), 0.5))
    return f"{detector.name}, {len(detector.classes)} classes, {len(detections)} detections in a grey picture"


def _cuda() -> str:
    import torch

    if not torch.cuda.is_available():
        raise MiSplatError(f"torch {torch.__version__} sees no GPU")
    picture = _render(variant="cuda_ad_rgb")
    return f"{torch.cuda.get_device_name()}; the middle pixel of one Gaussian is {_middle(picture):.2f}"


def _render(sh: Tensor | None = None, variant: str = "llvm_ad_rgb") -> Tensor:
    """A picture of one bright Gaussian in front of black, or of one with the colour `sh`."""
    import_at_once("torch")
    import torch

    from mi_splat.cameras import Camera, look_at
    from mi_splat.rendering import Renderer, RenderSettings
    from mi_splat.scene import GaussianScene

    scene = GaussianScene(
        means=torch.zeros(1, 3),
        scales=torch.full((1, 3), 0.2),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.tensor([0.9]),
        sh=torch.ones(1, 1, 3) if sh is None else sh,
    )
    camera = Camera(to_world=look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), focal=32.0, width=32, height=32)
    render = Renderer(RenderSettings(background=(0.0, 0.0, 0.0), variant=variant))
    return render(scene.to("cuda" if variant.startswith("cuda") else "cpu"), camera)


def _middle(picture: Tensor) -> float:
    """Brightness in the middle of a picture, which has to lie well above the corner's."""
    middle, corner = float(picture[16, 16].mean()), float(picture[0, 0].mean())
    if not middle > corner + 0.3:
        raise ValueError(
            f"a bright Gaussian should show in the middle; there it is {middle:.2f}, and {corner:.2f} in a corner"
        )
    return middle


GROUPS: dict[str, tuple[Probe, ...]] = {
    "renderer": (
        Probe(name="LLVM", run=_llvm, advice=llvm_hint()),
        Probe(name="variant", run=_variant, advice=f"{llvm_hint()}; or reinstall mitsuba and drjit"),
        Probe(name="one Gaussian", run=_one_gaussian, advice=f"if the process was ended, {llvm_hint()}"),
        Probe(name="one gradient", run=_one_gradient, advice=f"if the process was ended, {llvm_hint()}"),
    ),
    "detector": (
        Probe(
            name="torch pair",
            run=_torch_pair,
            advice="install both together, from one index: pip install --force-reinstall torch torchvision",
        ),
        Probe(name="one detector", run=_detector, advice="reinstall mi-splat; its weights are part of the package"),
    ),
    "CUDA": (
        Probe(
            name="CUDA",
            run=_cuda,
            advice="optional: all runs on the CPU; for a GPU install its driver and a torch built for CUDA",
            required=False,
        ),
    ),
}
EXTRAS = {
    "cluster": ("distributed",),
    "clip": ("open_clip",),
    "colmap": ("pycolmap",),
    "meshes": ("trimesh",),
    "report": ("jinja2", "matplotlib"),
    "robots": ("mujoco",),
    "tflite": ("tflite",),
    "transformers": ("transformers",),
    "usd": ("pxr",),
    "video": ("imageio_ffmpeg",),
    "view": ("viser",),
    "yolo": ("ultralytics",),
}
REGISTRIES = {
    "mi_splat.attacks": ("attacks.optimisers.registry", "OPTIMISERS"),
    "mi_splat.audit_rules": ("mi_splat.audit.lint.rules", "ADDED"),
    "mi_splat.conditions": ("attacks.observe.conditions", "CONDITIONS"),
    "mi_splat.detectors": ("attacks.detectors.registry", "DETECTORS"),
    "mi_splat.objectives": ("attacks.aims", "OBJECTIVES"),
    "mi_splat.poisons": ("attacks.poisons.specs", "POISONS"),
    "mi_splat.renderers": ("mi_splat.comparison.methods", "RENDERERS"),
}
"""Who reads each group of entry points."""


if __name__ == "__main__":  # in the child; a line is there as soon as its probe is done
    for word in sys.argv[1:]:
        runs = [partial(_brought, *word.split("/"))] if "/" in word else [probe.run for probe in GROUPS[word]]
        for run_one in runs:
            os.write(sys.stdout.fileno(), (json.dumps(run_one()) + "\n").encode())
