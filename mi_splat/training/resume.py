"""A training run in a folder: settings, checkpoints, figures and the splat, and going on where it stopped."""

import dataclasses
import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from mi_splat import provenance
from mi_splat.cameras import Camera, RenderFn, View, cameras_of, fingerprint_of
from mi_splat.errors import InvalidValueError
from mi_splat.interrupts import deferred_interrupt
from mi_splat.io import save_splat
from mi_splat.io.atomic import sweep_temporary
from mi_splat.io.documents import save_json
from mi_splat.io.folders import own_folder
from mi_splat.metrics import Perceptual
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.checkpoints import CheckpointError, load_state, save_state, to_json
from mi_splat.training.loop import Fit, FitConfig, OnStep, Progress, TrainState, advance, scene_extent
from mi_splat.training.state import check_start

CHECKPOINT, SPLAT, METRICS, CONFIG = "checkpoint.safetensors", "splat.ply", "metrics.json", "config.json"


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
    lpips: Perceptual | None = None,
    settings: Mapping[str, object] | None = None,
    dataset: Path | None = None,
    on_resume: Callable[[TrainState], None] | None = None,
    on_start: Callable[[TrainState], None] | None = None,
    on_step: OnStep | None = None,
    hold: Callable[[], bool] | None = None,
) -> Fit:
    """Train in a folder; a run that was stopped there goes on, and ends with the bits it would have had.

    A run also goes on to more iterations than it began with. It then differs from one that had so many from the start,
    since learning rates and densification follow the share of the iterations that is done.

    Writes config.json, checkpoint.safetensors every so many steps and when interrupted, and at the end splat.ply and
    metrics.json.

    Warns:
        UserWarning: A run goes on with another number of torch's threads, which may change its last bits.
    """
    if every < 1:
        raise InvalidValueError.of("every", "a positive number of steps", every, "1000 is usual")
    check_start(start, config)
    with own_folder(folder, CONFIG, CHECKPOINT):
        sweep_temporary(folder)
        path, digest = folder / CHECKPOINT, _digest(start, views, held_out)
        if path.is_file():
            state = _resumed(folder, config, seed=seed, digest=digest, settings=settings or {})
            state.to(start.means.device)
            if on_resume is not None:
                on_resume(state)
        else:
            state = TrainState(start, config, scene_extent=scene_extent(views), seed=seed)
            state.data_digest, state.settings = digest, dict(settings or {})
        given = {
            "settings": dict(settings or {}),
            "dataset": None if dataset is None else str(dataset),
            "poses": poses_digest(cameras_of(views)),
        }
        save_json({"config": to_json(config), "seed": seed, "views": len(views), **given}, folder / CONFIG)

        if on_start is not None:
            on_start(state)
        with deferred_interrupt() as interrupted:

            def after(line: Progress) -> None:
                if on_step is not None:
                    on_step(line)
                while hold is not None and hold() and not interrupted():
                    pass
                if interrupted() or line.iteration % every == 0 or line.iteration == config.iterations:
                    save_state(state, path)
                if interrupted():
                    raise KeyboardInterrupt

            fit = advance(state, views, render=render, held_out=held_out, lpips=lpips, on_step=after)
        save_splat(fit.scene, folder / SPLAT)
        save_json(_figures(fit, len(held_out)), folder / METRICS)
        return fit


def _resumed(folder: Path, config: FitConfig, *, seed: int, digest: str, settings: Mapping[str, object]) -> TrainState:
    """The run that was stopped in a folder; it may go on to more iterations than it began with."""
    state, threads = load_state(folder / CHECKPOINT)
    _check_same(state, config, seed, digest, folder)
    _check_settings(state, settings, folder)
    state.config = config
    if threads != torch.get_num_threads():
        now = torch.get_num_threads()
        text = f"the run began with {threads} threads of torch and goes on with {now}: its last bits may differ"
        warnings.warn(text, stacklevel=3)
    return state


def poses_digest(cameras: Sequence[Camera]) -> str:
    """What tells the poses of a set's cameras from others: nobody can guess it who does not have the set."""
    return hashlib.sha256(repr([camera.to_world.tolist() for camera in cameras]).encode()).hexdigest()


def _digest(start: GaussianScene, *sets: Sequence[View]) -> str:
    """Stands for what a run is trained and scored on; of a set on the disk no picture is decoded."""
    total = hashlib.sha256(scene_hash(start).encode())
    for views in sets:
        for camera in cameras_of(views):
            lens = (camera.focal, camera.principal, camera.width, camera.height)
            total.update(repr((camera.to_world.tolist(), lens)).encode())
        known = fingerprint_of(views)
        total.update(f"{len(views)} {known}".encode())
        if known is None:
            for view in views:
                total.update(view.image.detach().to("cpu", torch.float32).contiguous().numpy().tobytes())
    return total.hexdigest()


def _check_same(state: TrainState, config: FitConfig, seed: int, data: str, folder: Path) -> None:
    if state.data_digest != data:
        do = "pass those that it began with, held-out ones included, or train in another folder"
        raise CheckpointError.of(str(folder), "a run on the same pictures and start", "one on others", do)
    extended = dataclasses.replace(state.config, iterations=max(config.iterations, state.config.iterations))
    if config not in (state.config, extended) or state.seed != seed:
        old, new = to_json(state.config) | {"seed": state.seed}, to_json(config) | {"seed": seed}
        differs = ", ".join(f"{key} {old[key]} and not {new[key]}" for key in old if old[key] != new[key])
        raise CheckpointError.of(
            str(folder), f"a run with {differs}", "another", "use those, or train in another folder"
        )


def _check_settings(state: TrainState, settings: Mapping[str, object], folder: Path) -> None:
    """Raise if the pictures would no longer be made as before; older checkpoints do not know how they were made."""
    differs = [
        f"{key} {old} and not {settings.get(key)}" for key, old in state.settings.items() if settings.get(key) != old
    ]
    if differs:
        do = "use those, or train in another folder"
        raise CheckpointError.of(str(folder), f"a run with {', '.join(differs)}", "another", do)


def _figures(fit: Fit, held_out: int) -> dict[str, object]:
    """How true the held-out views are, and how it came about."""
    scores = fit.history[-1].held_out
    return {
        **dict.fromkeys(("psnr", "ssim", "lpips", "corrected_psnr")),
        **({} if scores is None else asdict(scores)),
        "held_out_views": held_out,
        "gaussians": len(fit.scene),
        "scene_hash": scene_hash(fit.scene),
        "threads": torch.get_num_threads(),
        "seed": fit.seed,
        "history": [asdict(line) for line in fit.history],
        **provenance.origin(),
    }
