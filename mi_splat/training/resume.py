"""A training run in a folder: settings, checkpoints, figures and the splat, and going
on where it stopped.
"""

import dataclasses
import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import save
from torch import Tensor

from mi_splat import provenance
from mi_splat.cameras.camera import Camera, RenderFn, View, cameras_of, fingerprint_of
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.documents import save_bytes, save_json, sweep_temporary
from mi_splat.io.folders import own_folder
from mi_splat.io.noted_tensors import (
    NOTES,
    check_like,
    described,
    read_line,
    read_noted_tensors,
)
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.processes import deferred_interrupt
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import Fit, OnStep, advance, scene_extent
from mi_splat.training.state import MOMENTS, Progress, TrainState, check_start
from mi_splat.training.strategies import strategy_config, strategy_name

FORMAT = 4  # of a checkpoint
_STRATEGY = "strategy/"
_MOST_VIEWS = 1 << 31


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another state."""


_READER = DocumentReader(
    expected="a checkpoint of this version",
    do="train anew in another folder",
    error=CheckpointError,
)


def to_json(config: FitConfig) -> dict[str, Any]:
    """The configuration as plain values; the `kind` of a strategy is the name that it
    is registered under.
    """
    plain = asdict(config)
    strategy = {"kind": strategy_name(config.strategy), **plain["strategy"]}
    return {**plain, "strategy": strategy, "trainable": list(config.trainable)}


def from_json(plain: dict[str, Any]) -> FitConfig:
    """The inverse of `to_json`; settings that are not there have their defaults, as in
    a file of an older version.
    """
    unknown = plain.keys() - {field.name for field in fields(FitConfig)}
    if unknown:
        do = (
            "end the run with the version that began it, or train anew in another"
            " folder"
        )
        raise InvalidValueError.of(
            "settings",
            "settings that this version knows",
            ", ".join(sorted(unknown)),
            do,
        )
    options = dict(plain["strategy"])
    strategy = strategy_config(options.pop("kind"), **options)
    return FitConfig(
        **{**plain, "strategy": strategy, "trainable": tuple(plain["trainable"])}
    )


def save_state(state: TrainState, path: Path) -> None:
    """Write a run between two steps; the old checkpoint stays until the new one is on
    the disk.
    """
    tensors = {
        f"parameters/{name}": value.detach() for name, value in state.parameters.items()
    }
    for name in state.trained:
        adam = state.optimiser.state.get(state.parameters[name], {})
        tensors |= {f"{key}/{name}": adam[key] for key in MOMENTS if key in adam}
    tensors |= {
        f"{_STRATEGY}{name}": value for name, value in state.strategy_state.items()
    }
    tensors["generator"] = state.generator.get_state()
    notes = {
        "format": FORMAT,
        "config": to_json(state.config),
        "scene_extent": state.scene_extent,
        "seed": state.seed,
        "data_digest": state.data_digest,
        "iteration": state.iteration,
        "view_queue": state.view_queue,
        "settings": state.settings,
        "version": provenance.versions().get("mi-splat"),
        "threads": torch.get_num_threads(),
        "history": [asdict(line) for line in state.history],
    }
    packed = save(
        {k: v.contiguous() for k, v in tensors.items()},
        metadata={NOTES: json.dumps(notes)},
    )
    save_bytes(packed, path)


def load_state(path: Path) -> tuple[TrainState, int]:
    """Read a run."""
    if not path.is_file():
        raise CheckpointError.of(
            f"checkpoint {path}", "a file", "nothing there", "train without resuming"
        )
    notes, tensors = read_noted_tensors(path, _READER)
    version = notes.values.get("format", 1)
    if version != FORMAT:
        do = "end it with the version that began it, or train anew in another folder"
        raise CheckpointError.of(
            f"checkpoint {path}", f"format {FORMAT}", f"format {version!r:.40}", do
        )
    try:
        return _assemble(notes, tensors), notes.whole("threads", 1, 1 << 20)
    except InvalidValueError as error:
        written = notes.values.get("version") or "an older version"
        raise CheckpointError(
            f"checkpoint {path}, written by mi-splat {written}: {error}"
        ) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        # of settings, which strategies check
        raise _READER.broken(
            f"checkpoint {path}", f"{type(error).__name__}: {error}"
        ) from error


def _assemble(notes: Fields, tensors: dict[str, Tensor]) -> TrainState:
    """The run in a checkpoint, every part of it checked against the others."""
    config = from_json(dict(notes.object("config").values))
    groups = _parts(tensors)
    means = groups["parameters"].get("means")
    if means is None or means.ndim != 2 or not len(means):
        raise _READER.broken(
            f"{notes.where}, means", described(means), "at least one row of 3 numbers"
        )
    extent = notes.number("scene_extent")
    seed = notes.whole("seed", -(1 << 63), (1 << 63) - 1)
    if not extent > 0:
        raise notes.bad("scene_extent", "a number above 0", extent)
    state = TrainState(
        _blank(len(means), config.sh_degree), config, scene_extent=extent, seed=seed
    )
    check_like(
        groups["parameters"], state.parameters, f"{notes.where}, parameters", _READER
    )
    with torch.no_grad():
        for name, value in groups["parameters"].items():
            state.parameters[name].copy_(value)
    for name in state.trained:
        adam = {key: groups[key][name] for key in MOMENTS if name in groups[key]}
        if adam:
            like = state.parameters[name].detach()
            check_like(
                adam,
                dict(zip(MOMENTS, (like, like, torch.zeros(())), strict=True)),
                notes.where,
                _READER,
            )
            state.optimiser.state[state.parameters[name]] = adam
    check_like(
        groups["strategy"], state.strategy_state, f"{notes.where}, strategy", _READER
    )
    state.strategy_state = groups["strategy"]
    _restore(state, notes, tensors.get("generator"))
    return state


def _parts(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The tensors of a checkpoint by what stands before the / in their names."""
    groups: dict[str, dict[str, Tensor]] = {
        group: {} for group in ("parameters", "strategy", *MOMENTS)
    }
    for key, value in tensors.items():
        group, _, name = key.partition("/")
        groups.setdefault(group, {})[name] = value
    return groups


def _blank(count: int, degree: int) -> GaussianScene:
    """A splat of `count` Gaussians, of which only the shapes are right."""
    return GaussianScene(
        torch.zeros(count, 3),
        torch.ones(count, 3),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count,), 0.5),
        torch.zeros(count, (degree + 1) ** 2, 3),
    )


def _restore(state: TrainState, notes: Fields, generator: Tensor | None) -> None:
    """Bring a run to where it has got to."""
    if generator is None:
        raise _READER.broken(notes.where, "none", "the state of a generator")
    check_like(
        {"generator": generator},
        {"generator": state.generator.get_state()},
        notes.where,
        _READER,
    )
    try:
        state.generator.set_state(generator)
    except RuntimeError as error:
        raise _READER.broken(
            f"{notes.where}, generator", str(error)[:100], "the state of a generator"
        ) from error
    state.settings = dict(notes.object("settings", {}).values)
    state.data_digest = notes.text("data_digest")
    state.iteration = notes.whole("iteration", 0, state.config.iterations)
    state.view_queue = notes.wholes("view_queue", 0, _MOST_VIEWS)
    state.history = [read_line(Progress, line) for line in notes.objects("history")]


CHECKPOINT = "checkpoint.safetensors"
SPLAT = "splat.ply"
BEST = "best.ply"
METRICS = "metrics.json"
CONFIG = "config.json"

Keep = Literal["best", "last"]
"""Which step's splat is the result: that of the evaluation with the highest held-out
PSNR, or the last one's.
"""


def train(
    views: Sequence[View],
    start: GaussianScene,
    folder: Path,
    *,
    render: RenderFn,
    config: FitConfig,
    seed: int = 0,
    held_out: Sequence[View] = (),
    every: int = 1000,
    keep: Keep | None = None,
    settings: Mapping[str, object] | None = None,
    dataset: Path | None = None,
    on_resume: Callable[[TrainState], None] | None = None,
    on_step: OnStep | None = None,
) -> Fit:
    """Train in a folder; a run that was stopped there goes on, and ends with the bits
    it would have had.

    A run also goes on to more iterations than it began with. It then differs from one
    that had so many from the start, since learning rates and densification follow the
    share of the iterations that is done.

    Writes config.json, checkpoint.safetensors every so many steps and when interrupted,
    and at the end splat.ply and metrics.json.
    With `keep`, best.ply is the best splat of all evaluations, and `keep` says whether
    it or the last step's is splat.ply: a splat of few photographs overfits. The
    held-out PSNR of the best is the largest of several, and so a little optimistic.

    Warns:
        UserWarning: A run goes on with another number of torch's threads, which may
        change its last bits.
    """
    if every < 1:
        raise InvalidValueError.of(
            "every", "a positive number of steps", every, "1000 is usual"
        )
    check_start(start, config)
    with own_folder(folder, CONFIG, CHECKPOINT):
        sweep_temporary(folder)
        path = folder / CHECKPOINT
        digest = _digest(start, views, held_out)
        if path.is_file():
            state = _resumed(
                folder, config, seed=seed, digest=digest, settings=settings or {}
            )
            state.to(start.means.device)
            if on_resume is not None:
                on_resume(state)
        else:
            state = TrainState(
                start, config, scene_extent=scene_extent(views), seed=seed
            )
            state.data_digest, state.settings = digest, dict(settings or {})
        given = {
            "settings": dict(settings or {}),
            "dataset": None if dataset is None else str(dataset),
            "poses": poses_digest(cameras_of(views)),
        }
        save_json(
            {"config": to_json(config), "seed": seed, "views": len(views), **given},
            folder / CONFIG,
        )

        with deferred_interrupt() as interrupted:

            def after(line: Progress) -> None:
                if on_step is not None:
                    on_step(line)
                # before the checkpoint, so that none is ahead of its best splat
                if keep is not None and best_of(state.history) is line:
                    save_splat(state.result(), folder / BEST)
                if (
                    interrupted()
                    or line.iteration % every == 0
                    or line.iteration == config.iterations
                ):
                    save_state(state, path)
                if interrupted():
                    raise KeyboardInterrupt

            fit = advance(state, views, render=render, held_out=held_out, on_step=after)
        last = fit.history[-1]
        kept = last
        if keep == "best":
            kept = best_of(fit.history) or last
        if kept is not last:
            fit = dataclasses.replace(fit, scene=load_splat(folder / BEST))
        save_splat(fit.scene, folder / SPLAT)
        save_json(_figures(fit, kept, len(held_out)), folder / METRICS)
        return fit


def best_of(history: Sequence[Progress]) -> Progress | None:
    """The evaluation with the highest held-out PSNR, the later one of equals; None
    where nothing is held out.
    """
    scored = [line for line in history if line.held_out is not None]
    return max(reversed(scored), key=_held_out_psnr, default=None)


def _held_out_psnr(line: Progress) -> float:
    assert line.held_out is not None
    return line.held_out.psnr


def _resumed(
    folder: Path,
    config: FitConfig,
    *,
    seed: int,
    digest: str,
    settings: Mapping[str, object],
) -> TrainState:
    """The run that was stopped in a folder; it may go on to more iterations than it
    began with.
    """
    state, threads = load_state(folder / CHECKPOINT)
    if state.data_digest != digest:
        do = (
            "pass those that it began with, held-out ones included, or train in another"
            " folder"
        )
        raise CheckpointError.of(
            str(folder), "a run on the same images and start", "one on others", do
        )
    shorter = dataclasses.replace(
        config, iterations=min(config.iterations, state.config.iterations)
    )
    old = {**to_json(state.config), "seed": state.seed, **state.settings}
    new = {
        **to_json(shorter),
        "seed": seed,
        **{key: settings.get(key) for key in state.settings},
    }
    differs = ", ".join(
        f"{key} {old[key]} and not {new[key]}" for key in old if old[key] != new[key]
    )
    if differs:
        do = "use those, or train in another folder"
        raise CheckpointError.of(str(folder), f"a run with {differs}", "another", do)
    state.config = config
    if threads != torch.get_num_threads():
        now = torch.get_num_threads()
        text = (
            f"the run began with {threads} threads of torch and continues with {now}:"
            " its last bits may differ"
        )
        warnings.warn(text, stacklevel=3)
    return state


def poses_digest(cameras: Sequence[Camera]) -> str:
    """What tells the poses of a set's cameras from others: nobody can guess it who does
    not have the set.
    """
    return hashlib.sha256(
        repr([camera.to_world.tolist() for camera in cameras]).encode()
    ).hexdigest()


def _digest(start: GaussianScene, *sets: Sequence[View]) -> str:
    """Stands for what a run is trained and scored on; of a set on the disk no image
    is decoded.
    """
    total = hashlib.sha256(scene_hash(start).encode())
    for views in sets:
        for camera in cameras_of(views):
            total.update(repr((camera.to_world.tolist(), camera.lens)).encode())
        known = fingerprint_of(views)
        total.update(f"{len(views)} {known}".encode())
        if known is None:
            for view in views:
                total.update(
                    view.image.detach()
                    .to("cpu", torch.float32)
                    .contiguous()
                    .numpy()
                    .tobytes()
                )
    return total.hexdigest()


def _figures(fit: Fit, kept: Progress, held_out: int) -> dict[str, object]:
    """How true the held-out views are, and how it came about."""
    scores = kept.held_out
    return {
        **dict.fromkeys(("psnr", "ssim")),
        **({} if scores is None else asdict(scores)),
        "held_out_views": held_out,
        "kept_iteration": kept.iteration,
        "gaussians": len(fit.scene),
        "scene_hash": scene_hash(fit.scene),
        "threads": torch.get_num_threads(),
        "seed": fit.seed,
        "history": [asdict(line) for line in fit.history],
        **provenance.origin(),
    }
