"""`mi-splat doctor`: check what `mi-splat dagger` needs on this machine, and say what to do where it does not work.

A broken libLLVM, or a torch that does not fit its torchvision, can end the whole process. So the checks run in child
processes (`python -m attacks.cli.doctor GROUP`). A child reports each check as soon as it is done, one JSON object a
line. If it ends early, the first check without a report has failed; the signal or the last line of stderr says why.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from mi_splat.cli.console import progress, show, show_json
from mi_splat.errors import MiSplatError, install
from mi_splat.llvm import llvm_hint
from mi_splat.provenance import versions

if TYPE_CHECKING:
    from torch import Tensor

State = Literal["works", "fails", "absent", "skipped"]
TIME_LIMIT = 300.0
"""Seconds that one group may take; the first kernels of a machine have to be compiled."""


class AbsentError(MiSplatError):
    """Something optional is not on this machine."""


EXAMPLES = ("doctor",)
SEE_ALSO = ("detectors",)


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """Render one Gaussian, take one gradient, load one detector; say what works and what to do about what does not.

    The exit status is 1 if something that `mi-splat dagger` needs does not work.
    """

    json: bool = False
    """Print the findings as one JSON document on stdout."""


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
    """Examine this machine; 1 if something that `mi-splat dagger` needs does not work."""
    with progress("checking", total=len(GROUPS)) as advance:
        findings = examine(lambda group: advance(f"checked {group}"))
    healthy = all(finding.state == "works" for finding in findings if finding.required)
    if options.json:
        show_json({"healthy": healthy, "findings": [dataclasses.asdict(finding) for finding in findings]})
        return 0 if healthy else 1
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        show(f"{finding.state:7}  {finding.name:{width}}  {finding.detail}")
        if finding.advice:
            show(f"{'':7}  {'':{width}}  -> {finding.advice}")
    show("all that mi-splat needs works" if healthy else "something that mi-splat needs does not work; see the arrows")
    return 0 if healthy else 1


def examine(on_done: Callable[[str], None] = lambda name: None) -> list[Finding]:
    """All findings on this machine, in the order in which one thing needs the other.

    Args:
        on_done: Called with the name of each group of checks when it is done.
    """
    findings = [_versions()]
    for group in GROUPS:
        findings += examine_group(group, [sys.executable, "-m", "attacks.cli.doctor", group])
        on_done(group)
    return findings + [_extra(name, module) for name, module in EXTRAS.items()]


def examine_group(group: str, command: list[str]) -> list[Finding]:
    """The findings of one group, whose probes run in the child process `command`."""
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
    ) as child:
        try:
            output, errors = child.communicate(timeout=TIME_LIMIT)
            reason = _end_of(child.returncode, errors)
        except subprocess.TimeoutExpired:
            child.kill()
            output, _ = child.communicate()
            reason = f"no answer after {TIME_LIMIT:.0f} s"
    reports = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    return list(_findings(GROUPS[group], reports, reason))


def _findings(probes: tuple[Probe, ...], reports: list[dict[str, object]], reason: str) -> Iterator[Finding]:
    """Match a child's reports with its probes; the first probe without one has failed for `reason`."""
    for index, probe in enumerate(probes):
        state: State
        if index < len(reports):
            state, detail = ("absent" if reports[index]["absent"] else "works"), str(reports[index]["detail"])
        else:
            state, detail = ("fails", reason) if index == len(reports) else ("skipped", "needs what failed before")
        advice = probe.advice if state in ("fails", "absent") else ""
        yield Finding(name=probe.name, state=state, detail=detail, advice=advice, required=probe.required)


def _end_of(status: int, errors: str) -> str:
    """Why a child ended: the signal that killed it, or the last line of its stderr."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    if status < 0:
        return f"the process was ended by {signal.Signals(-status).name}" + (f" ({lines[0]})" if lines else "")
    return re.sub(r"^(mi_splat|attacks)[\w.]*: ", "", lines[-1]) if lines else f"exit status {status}"


def _versions() -> Finding:
    """Python and the packages that matter; always works, since we run."""
    packages = ", ".join(f"{package} {number}" for package, number in versions().items())
    detail = f"{packages}; {platform.system()} {platform.machine()}"
    return Finding(name="versions", state="works", detail=detail, advice="", required=True)


def _extra(name: str, module: str) -> Finding:
    """Whether an optional package is there, without importing it."""
    there = importlib.util.find_spec(module) is not None
    return Finding(
        name=f"extra {name}",
        state="works" if there else "absent",
        detail=module if there else f"no {module}",
        advice="" if there else f"optional: {install(name)}",
        required=False,
    )


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
        raise AbsentError(f"torch {torch.__version__} sees no GPU")
    picture = _render(variant="cuda_ad_rgb")
    return f"{torch.cuda.get_device_name()}; the middle pixel of one Gaussian is {_middle(picture):.2f}"


def _render(sh: Tensor | None = None, variant: str = "llvm_ad_rgb") -> Tensor:
    """A picture of one bright Gaussian in front of black, or of one with the colour `sh`."""
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
    "cluster": "distributed",
    "figures": "matplotlib",
    "meshes": "trimesh",
    "report": "jinja2",
    "transformers": "transformers",
    "video": "imageio_ffmpeg",
    "view": "viser",
    "yolo": "ultralytics",
}


def report_group(group: str) -> None:
    """In the child: run the probes of a group in order, and report each on stdout as soon as it is done."""
    for probe in GROUPS[group]:
        try:
            detail, absent = probe.run(), False
        except AbsentError as error:
            detail, absent = str(error), True
        os.write(sys.stdout.fileno(), (json.dumps({"detail": detail, "absent": absent}) + "\n").encode())


if __name__ == "__main__":
    report_group(sys.argv[1])
