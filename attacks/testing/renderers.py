"""The contracts of a renderer (`mi_splat.RenderFn`), a condition, and a rule of the
audit.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from attacks.observe.conditions import Condition, Viewing
from attacks.testing.promises import (
    Contract,
    cloud,
    expect,
    expect_repeatable,
    expect_text,
    expect_uphill,
)
from mi_splat.attributes import ATTRIBUTES
from mi_splat.audit.rules import RULES, Rule, Severity, Stored
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.comparison.methods import RendererSpec
from mi_splat.errors import MiSplatError
from mi_splat.io.loaded import Loaded, arrays_of
from mi_splat.maths.rotation import normalise
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import RenderSettings
from mi_splat.scene import GaussianScene


def check_rule(rule: Any, *, finds: GaussianScene | None = None) -> None:
    """Raise unless a rule of the audit keeps its contract.

    It looks at healthy splats of any degree and size, in which there is nothing to
    find, and at one of broken numbers.

    Args:
        rule: The rule.
        finds: A splat in which it has to find something.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"rule {getattr(rule, 'name', type(rule).__name__)}")
    with contract.promise("names"):
        expect(
            isinstance(rule, Rule),
            "a Rule",
            type(rule).__name__,
            "make one of mi_splat.audit.rules.Rule",
        )
        good = re.fullmatch(r"[a-z][a-z0-9-]*", rule.name)
        expect(
            good,
            "a name of small letters, digits and dashes",
            rule.name,
            "choose another",
        )
        taken = rule is not None and any(
            rule.name == own.name and rule is not own for own in RULES
        )
        expect(not taken, "a name that is free", rule.name, "choose another")
        expect(
            rule.severity in get_args(Severity),
            " or ".join(get_args(Severity)),
            rule.severity,
            "choose one",
        )
        expect(
            rule.reason.endswith("."),
            "a sentence as reason",
            rule.reason,
            "say why it matters, and end it with .",
        )
    contract.settle()
    for count, degree in ((60, 3), (60, 0), (1, 1)):
        with contract.promise("healthy splats"):
            finding = rule(_stored(cloud(count, degree)))
            got = "" if finding is None else f"a finding in {finding.count} of {count}"
            expect(finding is None, "nothing", got, "raise the threshold")
    with contract.promise("broken numbers"):
        broken = _stored(cloud(60, 1), broken=True)
        rule(broken)
    with contract.promise("determinism"):
        splat = _stored(cloud(60, 3) if finds is None else finds)
        kept = {name: value.copy() for name, value in splat.arrays.items()}
        same = np.array_equal(
            rule.find(splat, rule.threshold), rule.find(splat, rule.threshold)
        )
        expect(same, "the same rows in a second look", "others", "draw nothing")
        stayed = all(
            np.array_equal(kept[name], value) for name, value in splat.arrays.items()
        )
        expect(stayed, "arrays that stay as they are", "others", "work on copies")
    if finds is not None:
        with contract.promise("what it finds"):
            expect(
                rule(_stored(finds)) is not None,
                "a finding",
                "none",
                "lower the threshold",
            )
    contract.settle()


def _stored(scene: GaussianScene, *, broken: bool = False) -> Stored:
    loaded = Loaded(arrays_of(scene), np.array([1, 2] if broken else [], np.int64), "")
    if broken:
        loaded.arrays["means"][1], loaded.arrays["scales"][2] = np.nan, -1.0
    return Stored.of(loaded)


_SIZE = (40, 28)
_COLOUR = (0.8, 0.4, 0.2)
_STEP = 3e-3
_SAME = 1e-4
_NEAR = 1.5
"""Shortest step along a gradient; how far equal values may be apart; pixels that a
Gaussian may be beside its place.
"""


def check_renderer(renderer: Any, *, differentiable: bool = True) -> None:
    """Raise unless a renderer keeps its contract.

    It renders a few Gaussians on the CPU: images have the size, the colours and the
    places that the conventions of this project say, gradients are true in all five
    tensors, and the same call gives the same image.

    Args:
        renderer: A function of a scene and a camera, or a `RendererSpec`, which then is
            asked for two backgrounds.
        differentiable: Whether gradients are promised; a spec says so itself.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    spec = renderer if isinstance(renderer, RendererSpec) else None
    contract = Contract(
        f"renderer {getattr(renderer, '__name__', type(renderer).__name__)}"
    )
    render: Any = renderer
    if spec is not None:
        differentiable = spec.differentiable
        with contract.promise("making it"):
            render = spec.make(RenderSettings())
        contract.settle()
    camera = _camera()
    scene = cloud(24, 1, size=2.5)
    with contract.promise("images"):
        _picture(render(scene, camera), camera)
        _picture(
            render(scene, _camera(offset=1.0, size=_SIZE[::-1])),
            _camera(size=_SIZE[::-1]),
        )
    with contract.promise("places"):
        beside = _one_gaussian((0.5, 0.0, 0.25), scale=0.05)
        light = (
            (render(beside, camera) - render(_nothing(), camera))
            .abs()
            .sum(-1)
            .detach()
            .double()
        )
        y, x = torch.meshgrid(
            *(torch.arange(side) + 0.5 for side in light.shape), indexing="ij"
        )
        seen = [
            float((light * axis).sum() / light.sum().clamp(min=1e-9)) for axis in (x, y)
        ]
        wanted = project_points(beside.means, camera)[0][0].tolist()
        gap = max(abs(a - b) for a, b in zip(seen, wanted, strict=True))
        got = f"({seen[0]:.1f}, {seen[1]:.1f})"
        do = (
            "cameras look along +z with x to the right and y down, and pixel (0, 0) has"
            " its middle at (0.5, 0.5)"
        )
        expect(
            gap <= _NEAR,
            f"a Gaussian at ({wanted[0]:.1f}, {wanted[1]:.1f}) pixels",
            got,
            do,
        )
    with contract.promise("colours"):
        middle = render(_one_gaussian((0.0, 0.0, 0.0), scale=0.6), camera)[
            _SIZE[1] // 2, _SIZE[0] // 2
        ].tolist()[:3]
        got = ", ".join(f"{value:.2f}" for value in middle)
        do = (
            "SH give sRGB colours as 0.5 plus their sum; blend these, without a"
            " transfer function"
        )
        expect(
            max(abs(a - b) for a, b in zip(middle, _COLOUR, strict=True)) < 0.06,
            f"sRGB {_COLOUR}",
            got,
            do,
        )
    with contract.promise("no Gaussians"):
        _picture(render(_nothing(), camera), camera, empty=True)
    with contract.promise("background"):
        if spec is not None:
            _background(spec, camera)
    for name in ATTRIBUTES if differentiable else ():
        with contract.promise(f"gradient of {name}"):
            _gradient(render, scene, camera, name)
    _is_repeatable(
        contract, render, scene, camera, "draw nothing, or from a seed of its own"
    )
    contract.settle()


def check_condition(condition: Any, *, name: str = "condition") -> None:
    """Raise unless a condition keeps its contract.

    Args:
        condition: What an entry point brings: a function of `Viewing`; or a
            `Condition`.
        name: What it is called.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"condition {name}")
    scene = cloud(24, 1, size=2.5)
    camera = _camera()
    made = condition
    with contract.promise("making it"):
        if not isinstance(condition, Condition):
            viewing = Viewing(
                settings=RenderSettings(),
                centre=(0.0, 0.0, 0.0),
                alone=lambda splat: splat,
            )
            made = condition(viewing)
            do = "return attacks.observe.conditions.rendered(name, render)"
            expect(isinstance(made, Condition), "a Condition", type(made).__name__, do)
        expect_text(made.name, "name")
    contract.settle()
    with contract.promise("cameras"):
        moved = made.move(camera)
        expect(
            isinstance(moved, Camera),
            "a Camera that it moves to",
            type(moved).__name__,
            "return a camera",
        )
        expect(
            isinstance(made.holds(camera), bool),
            "True or False from `holds`",
            made.holds(camera),
            "return a bool",
        )
    with contract.promise("images"):
        _picture(made(scene, camera), made.move(camera))
    _is_repeatable(
        contract,
        made,
        scene,
        camera,
        "take noise from a seed of its own, such as one of the camera",
    )
    contract.settle()


def _is_repeatable(
    contract: Contract, render: Any, scene: GaussianScene, camera: Camera, do: str
) -> None:
    """The same image in a second call, and a scene that stays as it is."""
    with contract.promise("determinism"):
        expect_repeatable(
            lambda: [render(scene, camera)],
            "the same image in a second call",
            do,
            atol=_SAME,
        )
    with contract.promise("scene"):
        _stays(lambda given: render(given, camera), scene)


def _camera(*, offset: float = 0.0, size: tuple[int, int] = _SIZE) -> Camera:
    pose = look_at((offset, -4.5, 0.6), (0.0, 0.0, 0.0))
    return Camera(to_world=pose, lens=Lens(focal=1.8 * max(size), size=size))


def _one_gaussian(mean: tuple[float, float, float], *, scale: float) -> GaussianScene:
    return GaussianScene(
        means=torch.tensor([mean]),
        scales=torch.full((1, 3), scale),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.tensor([0.99]),
        sh=colour_to_dc(torch.tensor([[_COLOUR]])),
    )


def _nothing() -> GaussianScene:
    return _one_gaussian((0.0, 0.0, 0.0), scale=1.0).select(
        torch.zeros(1, dtype=torch.bool)
    )


def _picture(picture: Any, camera: Camera, *, empty: bool = False) -> None:
    """Break the promise unless something is an image of a camera, which shows
    something.
    """
    expect(
        isinstance(picture, Tensor),
        "a torch tensor",
        type(picture).__name__,
        "give torch.from_numpy(...)",
    )
    shape = tuple(picture.shape)
    wanted = (camera.height, camera.width, 3)
    expect(
        shape == wanted,
        f"an image of shape {wanted}",
        shape,
        "give height, width, sRGB, of each camera's own size",
    )
    floating = picture.is_floating_point() and bool(torch.isfinite(picture).all())
    expect(
        floating,
        "finite floating-point values",
        picture.dtype,
        "give sRGB, in [0, 1] but for what is brighter",
    )
    low = float(picture.min())
    high = float(picture.max())
    expect(
        low >= -0.5 and high <= 2,
        "sRGB about in [0, 1]",
        f"{low:.3g} to {high:.3g}",
        "divide 8 bits by 255",
    )
    expect(
        empty or high - low > 0.02,
        "an image that shows something",
        "one colour",
        "look at the camera's pose",
    )


def _background(spec: RendererSpec, camera: Camera) -> None:
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)):
        try:
            render = spec.make(RenderSettings(background=background))
        except MiSplatError:  # which a renderer of black backgrounds may raise
            continue
        corner = render(_one_gaussian((0.0, 0.0, 0.0), scale=0.05), camera)[
            0, 0
        ].tolist()[:3]
        do = "use settings.background, or raise MiSplatError for those that cannot be"
        good = max(abs(a - b) for a, b in zip(corner, background, strict=True)) < 0.02
        expect(
            good,
            f"the background {background}",
            tuple(round(value, 2) for value in corner),
            do,
        )


def _gradient(
    render: Callable[..., Tensor], scene: GaussianScene, camera: Camera, name: str
) -> None:
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(camera.height, camera.width, 3, generator=generator)
    tensors: dict[str, Tensor] = {
        attribute: getattr(scene, attribute) for attribute in ATTRIBUTES
    }

    def measured(value: Tensor) -> Tensor:
        value = normalise(value) if name == "rotations" else value
        return (
            render(GaussianScene.unchecked(**{**tensors, name: value}), camera)
            * weights
        ).sum()

    do = "differentiate in all five tensors, or say differentiable=False"
    expect_uphill(measured, tensors[name], _STEP, do=do)


def _stays(look: Callable[[GaussianScene], object], scene: GaussianScene) -> None:
    kept = [value.clone() for value in scene.tensors()]
    look(scene)
    same = all(torch.equal(a, b) for a, b in zip(kept, scene.tensors(), strict=True))
    expect(
        same, "a scene that stays as it is", "another one", "work on scene.replace(...)"
    )
