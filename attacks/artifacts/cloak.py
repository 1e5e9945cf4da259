"""A finished study of CLOAK as an artifact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.artifacts.cloak_rows import DETECTIONS, HeldOutCamera, columns, held_out, study_rows, tables_of
from attacks.artifacts.contents import SPLATS, Contents, read_object
from attacks.artifacts.looking import agreement, look_again
from attacks.artifacts.packed import Kind, Packed
from attacks.artifacts.places import places_record
from attacks.artifacts.rows import Column
from attacks.artifacts.study_results import configuration_of, observed_splats, stage_splat, stated, study_of
from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.rates import figures, markdown
from attacks.cloak.study.run import SUMMARY
from attacks.report.study_toml import study_toml
from mi_splat.assets.mesh import Asset
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import decode
from mi_splat.io.camera_records import describe

STUDY = "study.toml"
_OTHER = ("files", "splats", "detectors", "seeds", "study", "versions", "commit", "variant", "seconds")
"""Keys of a summary that are no figures."""


def pack(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of a finished study holds.

    Args:
        folder: That `mi-splat cloak` has written.
        stages: Of its stages; None is a folder in `folder`.

    Raises:
        InvalidValueError: The study is not finished, or its observations are not there any more.
    """
    summary, stages = read_object(folder / SUMMARY), folder / "stages" if stages is None else stages
    try:
        study = decode(StudyConfig, stated(summary["study"]), str(folder / SUMMARY))
        observed, target = observed_splats(summary, stages), setup.target_of(study.scene)
        cameras = held_out(study, target)
        configuration = configuration_of(summary["study"])
        contents = Contents(
            kind="cloak",
            name=study.name,
            command=str(summary.get("command") or ""),
            configuration=configuration,
            seeds=tuple(summary["seeds"]),
            versions=summary["versions"],
            commit=summary["commit"],
            variant=summary["variant"],
            detectors=summary["detectors"],
            splats=tuple(summary["splats"]),
            tables=tables_of(study, observed, cameras),
        )
        stated_figures = {key: value for key, value in summary.items() if key not in _OTHER}
        splats = {splat_file(entry): _splat(entry, folder, stages, study) for entry in summary["splats"]}
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        do = "make it again with mi-splat cloak"
        raise InvalidValueError(message(str(folder / SUMMARY), "a summary of a study", repr(error), do)) from error
    return Packed(
        contents=contents,
        figures=stated_figures,
        cameras=_cameras(study, cameras, target),
        texts={STUDY: study_toml(configuration)},
        splats=splats,
    )


def derive(contents: Contents) -> Mapping[str, Any]:
    """Every figure of a study, of its rows alone.

    Raises:
        InvalidValueError: The rows are not those of the study.
    """
    study = study_of(contents.configuration, "configuration")
    return figures(study, study_rows(study, contents.splats, contents.tables))


def tables(contents: Contents) -> Mapping[str, Sequence[Column]]:
    """The tables of an artifact of CLOAK."""
    return columns(study_of(contents.configuration, "configuration"))


def page(derived: Mapping[str, Any], contents: Contents) -> str:
    """The tables of a study as `mi-splat cloak` writes them."""
    return markdown({**derived, "seeds": contents.seeds})


def splat_file(entry: Mapping[str, Any]) -> str:
    """What a splat of a study is called in an artifact."""
    return f"{SPLATS}/{entry['splat']}_{entry['seed']}.ply"


def _splat(entry: Mapping[str, Any], folder: Path, stages: Path, study: StudyConfig) -> Path | None:
    """Where a splat is: the results hold those of the first seed, the stages all."""
    first = folder / f"{entry['splat']}.ply"
    if entry["seed"] == study.seeds[0] and first.is_file():
        return first
    return stage_splat(entry["content"], stages)


def _cameras(study: StudyConfig, cameras: Sequence[HeldOutCamera], target: Asset) -> dict[str, Any]:
    """cameras.json of a study."""
    entries = [
        {**describe(str(view), place.camera), "box": None if place.box is None else list(place.box)}
        for view, place in enumerate(cameras)
    ]
    return places_record(
        entries,
        centre=list(setup.centre_of(study)),
        background=list(study.scene.background),
        near=setup.near_of(study, target),
    )


KIND = Kind(
    pack=pack,
    derive=derive,
    columns=tables,
    page=page,
    look=look_again,
    agree=agreement,
    further=(DETECTIONS,),
)
