"""What `mi-splat audit` leaves behind of a set of images: which of them contradict the
others.
"""

from pathlib import Path

from attacks.figures.result import Result
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Role,
    Section,
    sentence,
    settings,
)

_ELSEWHERE = (
    *("story", "file", "verdict", "summary", "groups", "scores", "pictures"),
    *("command", "versions", "variant", "commit", "torch"),
)
_ROLES: dict[str, Role] = {"A": "control", "B": "attack", "neither": "other"}
_PAIR = (
    "Two images from nearby directions that contradict each other: left one of group B,"
    " right one of group A. Which of them is true, the images do not say."
)


def read_image_audit(result: Result) -> Section:
    """The section of an audit of images."""
    record = result.record
    groups = record["groups"]
    first, *others = record["summary"]
    evidence = record["evidence"] or {}
    sizes = {f"images in {name}": len(images) for name, images in groups.items()}
    return Section(
        kind="audit of images",
        title=Path(record["file"]).name,
        attacked=False,
        done=(
            f"What {record['images']} images of {record['file']} show of"
            f" {record['points']:,} points was compared, and the two groups of images"
            " that contradict each other most were looked for."
        ),
        conclusion=sentence(first),
        headline=Figure(
            label="verdict",
            words=record["verdict"],
            note=(
                f"strength {evidence['strength']:.3f}, called from"
                f" {evidence['called_from']:g}"
                if evidence
                else ""
            ),
        ),
        figures=[Figure(label=name, words=str(size)) for name, size in sizes.items()],
        warnings=tuple(others),
        pictures=[
            Picture(path=result.folder / one["file"], caption=_PAIR, wide=True)
            for one in record["pictures"]
        ],
        charts=[_chart(groups, record["scores"] or {})],
        configuration=settings(
            {key: value for key, value in record.items() if key not in _ELSEWHERE}
        ),
    )


def _chart(groups: dict[str, list[str]], scores: dict[str, float]) -> Chart:
    """The score of each image, in the order of the set."""
    numbers = {name: number for number, name in enumerate(scores)}
    lines = [
        Line(
            name=f"group {group}" if group in ("A", "B") else group,
            role=_ROLES[group],
            points=tuple(Point(x=numbers[name], y=scores[name]) for name in images),
        )
        for group, images in groups.items()
        if images and scores
    ]
    return Chart(
        title="By how much less each image contradicts group B than group A",
        x_label="image",
        y_label="score",
        lines=tuple(lines),
        caption="Images between -0.15 and 0.15, and those that see little of what"
        " differs, belong to neither group.",
        fractions=False,
        connected=False,
    )
