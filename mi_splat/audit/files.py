"""The files of an audit: the account as JSON, the two pictures, the splat coloured by
heat, and the mask.
"""

import dataclasses
import importlib.metadata
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.audit.against import Changes
from mi_splat.audit.held_out import HeldOut, answer_of
from mi_splat.audit.held_out_files import (
    held_out_document,
    held_out_lines,
    save_contradictions,
)
from mi_splat.audit.linting import Lint, overdraw_picture
from mi_splat.audit.results import (
    Audit,
    Look,
    ObjectAudit,
    Pair,
    directions_in_words,
    headline,
    summary,
)
from mi_splat.audit.rules import Severity
from mi_splat.audit.surfaces import SKY
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.rooms import ROOMS
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import save_picture, side_by_side
from mi_splat.maths.sh import colour_to_dc, dc_to_colour
from mi_splat.provenance import origin
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene
from mi_splat.selection.select import save_mask

SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_RULES: dict[str, tuple[Severity, str, str]] = {
    "contradicted": (
        "error",
        (
            "What an object shows from a cone of directions contradicts what all other"
            " directions predict."
        ),
        (
            "Look at contradicted.png, which `mi-splat audit --out` writes; do not use"
            " the file unless you know why."
        ),
    ),
    "hidden-look": (
        "warning",
        (
            "An object has other colours from some directions than from others, and"
            " gloss does not explain it."
        ),
        (
            "Look at the pair of images that `mi-splat audit --out` writes, and ask who"
            " made the file."
        ),
    ),
    "suspicious-look": (
        "note",
        (
            "Colours of an object change with the direction of view more than gloss"
            " quite explains."
        ),
        "Look at the pair of images that `mi-splat audit --out` writes.",
    ),
    "fog": (
        "note",
        (
            "From one side of an object fog is seen: no training camera stood there, or"
            " something hides what it would see."
        ),
        "Pass the training cameras with `--cameras`.",
    ),
    "occluder": (
        "note",
        (
            "Something in the air covers an object from some directions, and cameras"
            " elsewhere look through it."
        ),
        (
            "Look at the object from the directions that are named; an honest canopy"
            " may look the same."
        ),
    ),
    "edited": (
        "note",
        (
            "Colours of an object have shades that neither paint nor light explains; an"
            " attack on a detector leaves them."
        ),
        (
            "Compare it with an older copy by `mi-splat audit --against`, or train it"
            " again."
        ),
    ),
    "unreadable": (
        "error",
        "The file is damaged, or of another kind than it says.",
        "Export it again; do not use it as it is.",
    ),
    "two-groups": (
        "warning",
        "Two groups of images of a set contradict each other.",
        "Look at the pair of images that `mi-splat audit --out` writes.",
    ),
    "unbounded": (
        "warning",
        "Colours may depend on the direction by more than the policy allows.",
        "Write a copy that does not with `mi-splat bound`.",
    ),
    "changed": (
        "warning",
        "The file differs from an older copy that is known to be clean.",
        "Look at what `mi-splat audit --against` shows of the difference.",
    ),
    "not-judged": (
        "error",
        (
            "The file, or a claim about it, was not judged, so that nothing is known"
            " of it."
        ),
        (
            "Do not use it until it is: `mi-splat gate` says why, and its policy says"
            " what a file may take."
        ),
    ),
}
"""Level, what is wrong, and what to do, by the name of the rule.

Rules of lint bring their own.
"""

_NOTED = ("unreadable", "not-judged")
"""Rules that say that the tool did not come to its end."""
# rule, level, what was found, and numbers of it
_Finding = tuple[str, Severity, str, dict[str, Any]]


def sarif(documents: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Files as one run of the tool, in SARIF 2.1.0; results name line 1, because
    readers want one.
    """
    rules = {name: _rule(name, *values) for name, values in _RULES.items()}
    results = []
    artifacts = []
    notes = []
    for index, document in enumerate(documents):
        address = {"uri": _address(document["file"]), "index": index}
        location = {
            "physicalLocation": {
                "artifactLocation": address,
                "region": {"startLine": 1},
            }
        }
        artifacts.append(
            {
                "location": {"uri": address["uri"]},
                "properties": {"verdict": document["verdict"]},
            }
        )
        more: list[_Finding] = [(*reason, {}) for reason in document.get("more", ())]
        if "error" in document:
            more.append(("unreadable", "error", document["error"], {}))
        if any(level == "error" and name in _NOTED for name, level, _, _ in more):
            text = "; ".join(text for name, _, text, _ in more if name in _NOTED)
            notes.append(
                {"level": "error", "message": {"text": text}, "locations": [location]}
            )
        artifacts[-1]["properties"]["summary"] = document.get("summary", [])
        for finding in document.get("lint") or ():
            name = f"lint/{finding['rule']}"
            rules.setdefault(
                name,
                _rule(
                    name,
                    _level(finding["severity"]),
                    finding["rule"],
                    finding["reason"],
                ),
            )
        found = [*findings(document), *more] if "objects" in document else more
        for name, level, text, values in found:
            rules.setdefault(name, _rule(name, _level(level), name, text))
            result = {
                "ruleId": name,
                "ruleIndex": list(rules).index(name),
                "level": level,
                "message": {"text": text},
            }
            results.append({**result, "locations": [location], "properties": values})
    driver = {
        "name": "mi-splat audit",
        "version": importlib.metadata.version("mi-splat"),
        "rules": [*rules.values()],
    }
    invocation = {"executionSuccessful": not notes, "toolExecutionNotifications": notes}
    run = {
        "tool": {"driver": driver},
        "invocations": [invocation],
        "artifacts": artifacts,
        "results": results,
    }
    return {"$schema": SCHEMA, "version": "2.1.0", "runs": [run]}


def findings(document: Mapping[str, Any]) -> Iterator[_Finding]:
    """What was found in a file."""
    thresholds = document["thresholds"]
    held_out = document.get("held_out", {})
    for text in held_out.get("contradictions", ()):
        sentence = f"{text[0].upper()}{text[1:]}."
        yield "contradicted", _RULES["contradicted"][0], sentence, {}
    for number, item in enumerate(document["objects"], 1):
        for index, look in enumerate(item["looks"], 1):
            evidence = look["net"] / look["threshold"]
            if evidence >= thresholds["suspicion"]:
                hides = look["evidence"] >= 1 and item["verdict"] == "hidden look"
                name = "hidden-look" if hides else "suspicious-look"
                text = (
                    f"Object {number}, look {index}: other colours {look['where']}; net"
                    f" {look['net']:.5f}."
                )
                values = {key: look[key] for key in _SCORES}
                yield name, _RULES[name][0], text, values
        if item["fogged"]:
            text = (
                f"Object {number}: one side shows fog, {item['looks'][0]['where']} or"
                " everywhere else."
            )
            yield (
                "fog",
                _RULES["fog"][0],
                text,
                {key: item["looks"][0][key] for key in ("lost", "air")},
            )
        if item["roofed"]:
            yield (
                "occluder",
                _RULES["occluder"][0],
                f"Object {number}: something far above covers it.",
                {},
            )
        cover = item["occluder"]
        if cover is not None and cover["score"] >= thresholds["covered"]:
            text = (
                f"Object {number}: something in the air covers it from around"
                f" {_axis(cover['axis'])}, and others see through it."
            )
            yield "occluder", _RULES["occluder"][0], text, {"score": cover["score"]}
        edit = item.get("edited")
        if edit is not None and edit["score"] >= 1:
            text = (
                f"Object {number}: its colours look edited, as an attack on a detector"
                " leaves them."
            )
            yield "edited", _RULES["edited"][0], text, edit
    for finding in document.get("lint") or ():
        count = f"{finding['count']:,} Gaussians. " if finding["count"] else ""
        text = f"{finding['rule']}: {count}{finding['reason']}"
        yield (
            f"lint/{finding['rule']}",
            _level(finding["severity"]),
            text,
            {"rows": finding["rows"]},
        )


def _axis(values: Sequence[float]) -> str:
    return "(" + " ".join(f"{value + 0.0:.2f}" for value in values) + ")"


def _rule(name: str, level: Severity, what: str, do: str) -> dict[str, Any]:
    texts = {"shortDescription": {"text": what}, "help": {"text": do}}
    return {"id": name, **texts, "defaultConfiguration": {"level": level}}


def _level(severity: str) -> Severity:
    """The level of a severity; what is of none of these is a warning."""
    return next((level for level in get_args(Severity) if level == severity), "warning")


def _address(file: str) -> str:
    """The name of a file as an address; a relative one stays relative to where the
    command ran.
    """
    path = Path(file)
    if path.is_absolute():
        return path.as_uri()
    return quote(os.fsencode(path.as_posix()))


PAIR = "pair.png"
HEAT = "heat.ply"
MASK = "mask.npy"
OVERDRAW = "overdraw.png"
HEAT_PICTURE = "heat.png"
EDITED = "edited.npy"
AGAINST = "against.png"
CHANGED = "changed.npy"
PICTURE = 512  # pixels along the longer side of each of the two pictures
_GAP = 8
_SCORES = (
    "direction",
    "incidence",
    "mirror",
    "net",
    "threshold",
    "support",
    "lost",
    "air",
)


def document(
    audit: Audit | None,
    lint: Lint | None = None,
    *,
    unjudged: str = "",
    held_out: HeldOut | None = None,
) -> dict[str, Any]:
    """An audit as JSON can hold it; where no object was judged, with the reason."""
    if audit is None:
        lines = [f"hidden appearance was not judged: {unjudged}"]
    else:
        lines = _account(audit, held_out)
    return {
        "verdict": audit and answer_of(audit, held_out),
        "summary": lines,
        "gaussians": len(audit.mask) if audit else lint and lint.gaussians,
        "carrying": int(audit.mask.sum()) if audit else 0,
        "near": audit.near if audit else 0.0,
        "thresholds": dataclasses.asdict(LIMITS) | dataclasses.asdict(ROOMS),
        "objects": [_of_object(item) for item in audit.objects] if audit else [],
        **({"against": audit.against.as_dict()} if audit and audit.against else {}),
        **({"up": list(audit.up)} if audit and audit.up else {}),
        **({"held_out": held_out_document(held_out)} if held_out else {}),
        **(lint.document() if lint else {}),
    }


def _account(audit: Audit, held_out: HeldOut | None) -> list[str]:
    """The answer with its first reason, and then all others."""
    answer = answer_of(audit, held_out)
    colours = headline(audit)
    if held_out is None:
        return [f"{answer}: {colours}", *summary(audit)]
    compared = held_out_lines(held_out)
    if held_out.views and held_out.answer == answer:
        first, *others = compared
        return [first, *others, colours, *summary(audit)]
    # only colours differ, or nothing else was compared
    return [f"{answer}: {colours}", *compared, *summary(audit)]


def _values(item: object, *names: str) -> dict[str, Any]:
    return {name: getattr(item, name) for name in names}


def _of_object(item: ObjectAudit) -> dict[str, Any]:
    cover = item.occluder
    return {
        **_values(item, "verdict", "evidence", "in_room", "fogged", "roofed"),
        "gaussians": len(item.rows),
        **_values(item, "centre", "radius", "up", "pieces", "area", "uncontradicted"),
        "looks": [_of_look(look, item) for look in item.looks],
        "occluder": cover and _values(cover, "axis", "transparent", "score"),
        "edited": _of_edit(item),
        "seen_from": [
            {
                "direction": direction,
                "looks": [look for look, shows in enumerate(shown) if shows],
                "blocked": blocked,
            }
            for direction, shown, blocked in zip(
                item.directions.tolist(),
                torch.stack([look.shown for look in item.looks], 1).tolist(),
                cover.blocked.tolist() if cover else [0.0] * len(item.directions),
                strict=True,
            )
        ],
    }


def _of_edit(item: ObjectAudit) -> dict[str, Any] | None:
    edit = item.edit
    if edit is None:
        return None
    return {
        **_values(
            edit, "score", "share", "usual_share", "grain", "usual_grain", "peak"
        ),
        "camera": edit.direction if edit.camera_known else None,
        "rows": sorted(edit.rows.tolist()) if item.edited else [],
    }


def _of_look(look: Look, item: ObjectAudit) -> dict[str, Any]:
    return {
        "where": directions_in_words(look.region, item.up),
        **_values(look, "evidence", *_SCORES, "changed"),
        "cameras": int(look.shown.sum()),
        "directions": dataclasses.asdict(look.region),
        "pair": (
            look.pair
            and {"change": look.pair.change, "cameras": pair_cameras(look.pair)}
        ),
    }


def pair_cameras(pair: Pair, number: int = 1) -> list[dict[str, object]]:
    """The two cameras of a look with a number as JSON can hold them."""
    end = f" {number}" if number > 1 else ""
    return [
        describe(f"inside{end}", pair.inside),
        describe(f"outside{end}", pair.outside),
    ]


def pair_picture(scene: GaussianScene, pair: Pair) -> NDArray[np.uint8]:
    """(H, W, 3) the two images that prove an appearance: from inside its directions
    left, from outside right.
    """
    cameras = [_enlarged(camera) for camera in (pair.inside, pair.outside)]
    render = Renderer(RenderSettings(background=SKY, near=near_plane(scene, cameras)))
    with torch.no_grad():
        return side_by_side([render(scene, camera) for camera in cameras])


def changes_picture(changes: Changes, scene: GaussianScene) -> NDArray[np.uint8]:
    """(H, W, 3) the clean splat on the left, another on the right, a row for each
    camera.
    """
    render = Renderer(
        RenderSettings(background=SKY, near=near_plane(scene, changes.cameras))
    )
    with torch.no_grad():
        rows = [
            side_by_side([render(item, camera) for item in (changes.clean, scene)])
            for camera in changes.cameras
        ]
    gap = np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (gap, row)][1:])


def _enlarged(camera: Camera) -> Camera:
    factor = PICTURE / max(camera.width, camera.height)
    return resized(
        camera, (round(camera.width * factor), round(camera.height * factor))
    )


def heated(scene: GaussianScene, heat: Tensor) -> GaussianScene:
    """The splat in pale grey, redder the more heat a Gaussian has; the same from
    everywhere.
    """
    share = (heat / heat.max().clamp(min=1e-12))[:, None].to(scene.sh)
    grey = 0.4 + 0.5 * dc_to_colour(scene.sh[:, 0]).clamp(0, 1).mean(
        1, keepdim=True
    ).expand(-1, 3)
    colour = (1 - share) * grey + share * grey.new_tensor([0.9, 0.05, 0.0])
    return GaussianScene.unchecked(*scene.tensors()[:4], colour_to_dc(colour)[:, None])


def write(
    audit: Audit | None,
    scene: GaussianScene | None,
    folder: str | os.PathLike[str],
    *,
    source: str,
    lint: Lint | None = None,
    held_out: HeldOut | None = None,
    unjudged: str = "",
    force: bool = False,
) -> list[Path]:
    """Write the files of an audit into a new folder, whole or not at all."""
    target = Path(folder)
    more = dict[str, Any](pictures=[], cameras=[])
    with new_folder(target, force=force) as temporary:
        if audit is not None and scene is not None:
            more = _evidence(audit, scene, temporary)
        if held_out is not None:
            save_contradictions(held_out, temporary)
        if lint is not None and lint.overdraw is not None:
            save_picture(overdraw_picture(lint.overdraw), temporary / OVERDRAW)
        names = [RECORD, *sorted(file.name for file in temporary.iterdir())]
        record = {
            "story": "audit",
            "file": source,
            **document(audit, lint, unjudged=unjudged, held_out=held_out),
            **more,
        }
        save_json({**record, **origin()}, temporary / RECORD)
    return [target / name for name in names]


def _evidence(audit: Audit, scene: GaussianScene, folder: Path) -> dict[str, Any]:
    """Save what proves an audit, and say which images and cameras prove appearances."""
    if bool(audit.mask.any()):
        hot = heated(scene, audit.heat)
        save_splat(hot, folder / HEAT)
        save_mask(audit.mask, folder / MASK)
        if audit.strongest.look.pair is not None:
            save_picture(
                pair_picture(hot, audit.strongest.look.pair), folder / HEAT_PICTURE
            )
    edited = [
        item.edit.rows
        for item in audit.objects
        if item.edit is not None and item.edited
    ]
    if edited:
        save_mask(
            torch.zeros(len(scene), dtype=torch.bool).index_fill_(
                0, torch.cat(edited), True
            ),
            folder / EDITED,
        )
    if audit.against is not None and audit.against.cameras:
        save_picture(changes_picture(audit.against, scene), folder / AGAINST)
    if audit.against is not None and bool(audit.against.mask.any()):
        save_mask(audit.against.mask, folder / CHANGED)
    return save_pairs(audit, folder, lambda pair: pair_picture(scene, pair))


def save_pairs(
    audit: Audit, folder: Path, show: Callable[[Pair], NDArray[np.uint8]]
) -> dict[str, Any]:
    """Save the pictures that prove looks."""
    pictures = list[dict[str, Any]]()
    cameras = list[dict[str, object]]()
    for number, (numbers, pair) in enumerate(shown_pairs(audit), 1):
        name = PAIR if number == 1 else f"pair-{number}.png"
        save_picture(show(pair), folder / name)
        pictures.append(
            {
                "file": name,
                "object": numbers[0],
                "look": numbers[1],
                "change": pair.change,
            }
        )
        cameras += pair_cameras(pair, number)
    return {"pictures": pictures, "cameras": cameras}


def shown_pairs(audit: Audit) -> list[tuple[tuple[int, int], Pair]]:
    """Pairs of cameras that are worth a picture, the strongest first: all with
    evidence, of none at least one.
    """
    looks = [
        ((index, number), look)
        for index, item in enumerate(audit.objects)
        for number, look in enumerate(item.looks)
        if look.pair is not None
        and (look.evidence >= LIMITS.suspicion or item is audit.strongest)
    ]
    looks.sort(
        key=lambda entry: (
            audit.objects[entry[0][0]] is not audit.strongest,
            -entry[1].evidence,
        )
    )
    return [(numbers, look.pair) for numbers, look in looks if look.pair is not None]
