"""What `mi-splat dagger-eot` leaves behind: one object from all cameras of a region, judged on held-out views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.stories.dagger import ball, object_of, verb, wish
from attacks.report.wording import counted, known, listed, number, percent, plural, sentence, settings

KIND = "DAGGER, from all cameras of a region"
_ANGLES = {"by_azimuth": "azimuth", "by_elevation": "elevation"}
_RATES = {
    "success": "attacked: success",
    "noise": "random noise: success",
    "clean": "no attack: success",
    "found_clean": "clean object found",
    "found_attacked": "attacked object found",
}


def read(folder: Path, result: Mapping[str, Any]) -> Section:
    """The section of a result.

    Args:
        folder: Where it lies.
        result: Its result.json.
    """
    rate, noise, clean = (known(result[name]) for name in ("rate", "noise_rate", "clean_rate"))
    config, names = result["config"], list(result["rates"])
    needed, budget = config["required_views"], config["image_psnr"]
    asked = "" if budget is None else f", while the pictures keep {budget:g} dB"
    return Section(
        kind=KIND,
        title=f"{object_of(result, result['rates'].values(), otherwise='the object')} {wish(result)}, all cameras",
        folder=str(folder),
        done=(
            f"The Gaussians of one object ({result['object_gaussians']:,}, of which {result['changed_gaussians']:,} "
            f"changed) were moved within {ball(result)}{asked}, in {plural(config['steps'], 'step')} over random "
            f"cameras of a region, to make {listed(names)} {verb(result)}. The attacker knows the weights. "
            f"{plural(rate.total, 'view')} that the search has never seen judged the saved file, in 8-bit pictures."
        ),
        conclusion=_conclusion(result, rate, noise, needed),
        headline=Figure(label=f"held-out views with the aim reached: {verb(result)}", rate=rate),
        control=Figure(label="random noise of the same size, on the same views", rate=noise) if noise.total else None,
        figures=_figures(result, clean),
        warnings=tuple(
            sentence(text) for text in (*result["warnings"], *doubts_of(rate, noise, what="held-out views"))
        ),
        pictures=shown(
            [
                Picture(
                    path=folder / "held_out.png",
                    caption="Held-out views all around: clean on the left of each pair, attacked on the right.",
                    alt=(
                        "Pairs of pictures with boxes; the aim is reached in "
                        f"{rate.successes} of {rate.total} held-out views"
                    ),
                    wide=True,
                )
            ]
        ),
        charts=tuple(
            _chart(result[key], name, needed) for key, name in _ANGLES.items() if len(_counted(result[key])) > 1
        ),
        tables=(_detectors(result["rates"]),),
        configuration=settings({**config, **_conditions(result)}),
    )


def _conclusion(result: Mapping[str, Any], rate: Rate, noise: Rate, needed: float) -> str:
    outcome = "holds" if result["success"] else "does not hold"
    control = f" Random noise of the same size: {noise.successes} of {noise.total}." if noise.total else ""
    return (
        f"From cameras that the search has not seen, the attack {outcome}: {rate.successes} of "
        f"{plural(rate.total, 'view')}, where {percent(needed)} are asked for.{control} This says nothing of detectors "
        "that were not attacked."
    )


def _figures(result: Mapping[str, Any], clean: Rate) -> tuple[Figure, ...]:
    noise = [psnr for psnr in result["noise_psnr"] if psnr is not None]
    return (
        Figure(label="no attack, on the same views", rate=clean),
        Figure(
            label="success without another class of more confidence on the object",
            rate=known(result["unambiguous_rate"]),
        ),
        Figure(
            label="pictures, attacked against clean",
            words=number(result["image_psnr"], unit="dB"),
            note="PSNR of the mean squared error over all held-out views; 26 is easily seen, 40 hardly",
        ),
        *([Figure(label="pictures with the noise", words=number(noise[0], unit="dB"))] if noise else []),
        *(
            Figure(label=f"size of the change, {name}", words=f"{used:.3g}")
            for name, used in result["used_in_file"].items()
        ),
        Figure(label="best step", words=f"{result['steps']} of {result['config']['steps']}"),
        Figure(label="time", words=number(result["seconds"], ".0f", "s")),
    )


def _detectors(rates: Mapping[str, Any]) -> Table:
    rows = tuple((words, *(counted(known(one[key])) for one in rates.values())) for key, words in _RATES.items())
    return Table(caption="Each detector on the held-out views", head=("rate", *rates), rows=rows)


def _counted(lines: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [line for line in lines if line["total"]]


def _chart(lines: Sequence[Mapping[str, Any]], angle: str, needed: float) -> Chart:
    points = tuple(Point.of((line["from"] + line["to"]) / 2, known(line)) for line in _counted(lines))
    return Chart(
        title=f"Success by {angle}",
        caption=(
            "Held-out views in equal parts of the region; bands are 95 % intervals. "
            f"Of all views {percent(needed)} are asked for."
        ),
        x_label=f"{angle} of the camera, degrees",
        y_label="views with success",
        lines=(Line(name="attacked", role="attack", points=points),),
        level=(needed, "asked for"),
    )


def _conditions(result: Mapping[str, Any]) -> dict[str, Any]:
    names = ("scene", "selection", "cameras", "reference", "background", "near", "scene_hash", "redraws")
    weights = {entry["detector"]: entry["detector_fingerprint"] for entry in result["detectors"]}
    return {**{name: result[name] for name in names if name in result}, "weights": weights}
