"""The jobs that `mi-splat view` offers: audit a splat, and attack the selected object. Each is a command."""

from collections.abc import Iterator
from pathlib import Path

from attacks.cli.names import DEFAULT_TARGET
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.registry import DETECTORS, load_detector
from attacks.limits import NORM_NAMES
from attacks.rate import FIXED
from attacks.report.results import read_section
from attacks.report.viewer_content import detector_inspector, open_content
from mi_splat.audit.files import HEAT
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.viewer.content import Content
from mi_splat.viewer.jobs import Choice, JobKind, JobRequest, JobResult, Number
from mi_splat.viewer.orbit import camera_options, up_options

OBJECTIVES = ("relabel", "hide", "untargeted")


def audit_job(content: Content) -> JobKind:
    """An audit of one of the splats."""
    names = tuple(splat.name for splat in content.splats)
    field = Choice(name="splat", label="Splat", options=names, default=names[-1])
    return JobKind(name="Audit", fields=(field,), out=Path("out/audit"), arguments=_audit, opened=_audited)


def _audit(request: JobRequest, mask: Path, out: Path) -> list[str]:
    return ["audit", str(_audited_file(request)), *up_options(request.content.up), "--out", str(out)]


def _audited_file(request: JobRequest) -> Path:
    """The file of the chosen splat; of the first where that is shown no longer."""
    splats = {splat.name: splat.path for splat in request.content.splats}
    return splats.get(str(request.values["splat"]), request.content.splats[0].path)


def _audited(request: JobRequest, out: Path) -> JobResult:
    """What was found; if anything, the splat next to its heat map."""
    record = read_json(out / RECORD)
    shown = None
    if record["verdict"] not in (None, "nothing found") and (out / HEAT).is_file():
        shown = open_content(out, clean=_audited_file(request), up=request.content.up)
    return JobResult(lines=tuple(map(str, record["summary"])), content=shown)


def attack_job(detector: str | None = None, *, weights: Path | None = None) -> JobKind:
    """A DAGGER attack; the named detector, with its weights, is the default one."""
    known = {detector: DETECTORS[detector].classes} if detector is not None else {}
    known |= {name: classes for name, classes in available() if name not in known}
    files = {} if detector is None or weights is None else {detector: weights}
    classes = tuple(dict.fromkeys(label for labels in known.values() for label in labels))
    target = DEFAULT_TARGET if DEFAULT_TARGET in classes else classes[0]

    def arguments(request: JobRequest, mask: Path, out: Path) -> list[str]:
        content, values, picked = request.content, request.values, request.picked
        if picked is None:
            raise InvalidValueError(message("Attack", "an object", "none", "click on one in the picture"))
        splat, size, name = content.splat(picked.splat), content.size_at(request.orbit), str(values["detector"])
        camera = camera_options(request.orbit, size, settings=content.settings, up=content.up, path=splat.path)
        options = ["--mask", str(mask), "--detectors", name]
        options += ["--weights", str(files[name])] if name in files else []
        options += ["--objective", str(values["objective"])]
        options += ["--target", str(values["target"])] if values["objective"] == "relabel" else []
        options += ["--norm", str(values["norm"]), "--eps", f"{values['eps']:g}", "--steps", f"{values['steps']:.0f}"]
        return ["dagger", str(splat.path), *options, *camera, "--out", str(out)]

    def opened(request: JobRequest, out: Path) -> JobResult:
        assert request.picked is not None
        name, content = str(request.values["detector"]), request.content
        return JobResult(
            lines=tuple(_summary(out)),
            content=open_content(out, clean=content.splat(request.picked.splat).path, up=content.up),
            inspector=detector_inspector(load_detector(name, weights=files.get(name))),
        )

    fields = (
        Choice(name="detector", label="Detector", options=tuple(known), default=next(iter(known))),
        Choice(name="objective", label="Objective", options=OBJECTIVES, default="relabel"),
        Choice(name="target", label="Class (relabel)", options=classes, default=target),
        Choice(name="norm", label="Norm", options=tuple(NORM_NAMES), default="l2"),
        Number(name="eps", label="eps", low=0.1, high=50.0, step=0.1, default=5.0),
        Number(name="steps", label="Steps", low=1, high=500, step=1, default=11),
    )
    return JobKind(name="Attack", fields=fields, out=Path("out/dagger"), arguments=arguments, opened=opened)


def available() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names and classes of the detectors that can be loaded without any download."""
    for name in DETECTORS:
        try:
            spec = DETECTORS[name]
        except DetectorError:  # of an installed package that is broken
            continue
        if not spec.missing():
            yield name, spec.classes


def _summary(result: Path) -> Iterator[str]:
    """The conclusion, the figures and the warnings of a result's report."""
    section = read_section(result)
    yield section.conclusion.replace(FIXED, " ")
    for figure in section.all_figures:
        yield f"{figure.label}: {'; '.join(filter(None, (figure.cell, figure.note)))}".replace(FIXED, " ")
    for text in section.warnings:
        yield f"Warning: {text}".replace(FIXED, " ")
