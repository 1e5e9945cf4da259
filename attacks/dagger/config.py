"""How DAGGER attacks, as one value: the API, the flags of the command line and the
snapshot in every result.

Light, so that `--help` is fast: torch is imported when the budget is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

from attacks.observe import Control
from attacks.optimisers import NormName, OptimiserSpec, Radius, Schedule, optimiser_spec
from attacks.threats import names
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Count,
    Degree,
    Fraction,
    Metavar,
    PositiveFraction,
    Seed,
    Share,
    Steps,
    above,
    at_least,
    check,
    check_choice,
)

if TYPE_CHECKING:
    from attacks.search.budget import Budget


VIEWS: dict[str, Any] = {
    "eps": (1.0,),
    "norm": "linf",
    "steps": 60,
    "step_factor": 2.4,
    "optimiser": "adam",
    "momentum": 0.8,
    "schedule": "linear",
    "sh_degree": 0,
    "object_psnr": 34.0,
    "validate_every": 10,
}
"""Defaults for chosen cameras: what one sees of the object is the budget. Tuned on a
captured person on `centernet_coco` (see docs/dagger.md).
"""

BALL: dict[str, Any] = {
    "step_factor": 10.0,
    "momentum": 0.2,
    "schedule": "linear",
}
"""Defaults for chosen cameras where a ball of coefficients is the budget, tuned on two
pairs of the sign on `fasterrcnn_small` (see docs/dagger.md).
"""

REGION: dict[str, Any] = {
    "eps": (1.0,),
    "norm": "linf",
    "steps": 150,
    "step_factor": 13.0,
    "optimiser": "adam",
    "momentum": 0.8,
    "schedule": "linear",
    "required_views": 0.8,
    "noise_draws": 1,
    "sh_degree": 1,
    "batch": 3,
    "image_psnr": 26.3,
}
"""Defaults for a region of cameras, tuned on a few pairs of the example scenes (see
docs/dagger-eot.md).
"""


NARROW: dict[str, Any] = {
    "eps": (1.0,),
    "norm": "linf",
    "steps": 100,
    "step_factor": 6.0,
    "optimiser": "adam",
    "momentum": 0.8,
    "schedule": "linear",
    "sh_degree": 0,
    "object_psnr": 36.0,
    "local_gap": 6.0,
    "batch": 3,
    "pool": 32,
    "validation": 12,
    "validate_every": 20,
    "required_views": 0.8,
    "stop_at": 1.0,
    "noise_draws": 1,
    "held_out": 40,
}
"""Defaults around a chosen camera: what one sees of the object is the budget, and
images are changed during the search. Chosen on one camera of a captured person, on
`centernet_coco` and `ssd_openimages` (see docs/dagger.md).
"""

NARROW_CHANGES: dict[str, Any] = {
    "jpeg": 50,
    "blur": 1.0,
    "resize": 0.5,
    "exposure": 0.1,
    "noise": 0.01,
    "plain": 0.35,
    "sizes": (0.4, 2.0),
}
"""What happens to images during such a search, as `PictureChanges` has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig:
    """How to attack; the defaults of the class are those of the paper's text.

    `for_views` has the defaults of `mi-splat dagger`, and `for_region` those for a
    region of cameras.

    Attributes:
        attributes: What of the object may change: means, scales, rotations, opacities
            or sh of its Gaussians, its place as a whole (shift, turn), its shape
            (lattice), or the name of another threat that was registered.
        eps: Radius of the ball in the units of the splat file: one for all attributes,
            or one for each.
        norm: How the change is measured: one ball over the whole object (linf, l2), or
            one for each Gaussian.
        steps: Number of steps.
        step_factor: The first step is eps * step_factor / steps long.
        optimiser: How the next point is chosen: pgd, fgsm, momentum, adam, apgd, cw
            (with a price of the change), square and random (without gradients), or the
            name of another that was registered.
        momentum: Share of the earlier gradients that is kept at each step, in [0, 1);
            None is the optimiser's own, 0 of pgd.
        schedule: How the steps become shorter (pgd, momentum, adam).
        gradient_power: Power of the gradients' absolute values before a step of pgd or
            momentum, in [0, 1]; below 1, small ones count for more (see
            `attacks.optimisers.methods.momentum`).
        required_views: Fraction of the views in which the attack has to succeed, with
            every detector.
        controls: Random changes that an attack has to beat: white noise that changes
            the object's pixels as much as it does, by PSNR (noise), smooth changes that
            do so (smooth-noise), or white noise of the attack's norm (norm-noise),
            which averages out and changes pixels much less.
        noise_draws: Draws of each control.
        sh_degree: Highest degree of the SH coefficients that may change, if SH may; the
            file gets it if it has less, with new coefficients that start at 0. 3 is
            what 3DGS writes and what the paper attacked; 0 changes a Gaussian's colour
            by the same from everywhere. None keeps the scene's own.
        restarts: Number of runs; the first starts at the clean object, the others at
            random points of the ball.
        random_start: Start the first run at a random point of the ball, too.
        early_stop: Whether the first unambiguous success from chosen cameras ends the
            search; without, every step of every run is taken.
        alone: Whether the search looks at the object alone, on the renderer's
            background, as the paper's code does. What it finds is judged in the scene
            all the same.
        in_turn: Whether several cameras are attacked one after the other, each from
            where the one before has ended, as in the paper's code; otherwise all at
            once.
        image_psnr: PSNR that the images keep, dB, over the views that decide; None asks
            for nothing. The search then pays for their squared error
            (`attacks.dagger.search`); the ball is a second bound.
        object_psnr: The same over the pixels that are at least half the object's. The
            attack ends at this limit: its change is scaled until the object has this
            PSNR.
        local_gap: How far the PSNR of any part of the object may be below object_psnr,
            dB; a part is a square window, a sixth of the object's box wide. A mean
            alone lets one part, such as an ear, carry the whole change. None sets no
            limit.
        ladder: Values of object_psnr to try in turn, the highest first, each from where
            the one before ended. The answer is the first at which the attack succeeds
            in the views that decide, or the last. Levels after the first take half the
            steps.
        batch: Views of each step: of the cameras, where 0 is all of them, or of the
            pool that a region has.
        pool: Number of views of a region that they are drawn from; 0 draws new ones at
            each step.
        validation: Views of a region, no others, that decide which step was best.
            Chosen cameras decide themselves.
        validate_every: Steps between two such decisions; where every step takes all
            cameras, each is one.
        stop_at: Fraction of the validation views of a region whose success ends the
            search; None takes every step.
        held_out: Number of held-out views that judge the result of a region.
        seed: Seed of everything random: starting points, the attack's and the
            validation views, and the noise.
        judge_seed: Seed of the held-out views of a region; another one.

    Raises:
        InvalidValueError: A value is out of its range, or there are not as many radii
            as attributes.
    """

    attributes: tuple[Annotated[str, Metavar("ATTRIBUTE")], ...] = ("sh",)
    eps: tuple[Radius, ...] = (5.0,)
    norm: NormName = "l2"
    steps: Steps = 11
    step_factor: Annotated[
        float, above(0, do="2 is the paper's"), Metavar("FACTOR")
    ] = 2.0
    optimiser: Annotated[str, Metavar("OPTIMISER")] = "pgd"
    momentum: Share | None = None
    schedule: Schedule = "constant"
    gradient_power: Fraction = 1.0
    required_views: PositiveFraction = 1.0
    controls: tuple[Control, ...] = ("noise",)
    noise_draws: Count = 5
    sh_degree: Degree | None = 3
    restarts: Annotated[int, at_least(1)] = 1
    random_start: bool = False
    early_stop: bool = True
    alone: bool = False
    in_turn: bool = False
    image_psnr: (
        Annotated[float, above(0, "dB", "26 is easily seen, 40 hardly")] | None
    ) = None
    object_psnr: (
        Annotated[float, above(0, "dB", "34 is seen beside the clean object")] | None
    ) = None
    local_gap: Annotated[float, above(0, "dB", "6 is four times the error")] | None = (
        None
    )
    ladder: tuple[Annotated[float, above(0, "dB"), Metavar("DB")], ...] = ()
    batch: Annotated[int, at_least(0, "views", "0 is all cameras")] = 0
    pool: Annotated[int, at_least(0, "views", "0 draws new ones at each step")] = 200
    validation: Annotated[int, at_least(1, "views")] = 12
    validate_every: Steps = 50
    stop_at: PositiveFraction | None = None
    held_out: Annotated[int, at_least(1, "views")] = 60
    seed: Seed = 0
    judge_seed: Seed = 1000

    def __post_init__(self) -> None:
        check(self)
        optimiser_spec(self.optimiser)
        for name in self.attributes:
            check_choice("attributes", name, names())
        has_threat = any(name not in ATTRIBUTES for name in self.attributes)
        if has_threat and "smooth-noise" in self.controls:
            raise InvalidValueError.of(
                "controls",
                "noise or norm-noise, for an attack on more than Gaussians",
                "smooth-noise",
                "leave it out",
            )
        if self.image_psnr is not None and self.object_psnr is not None:
            raise InvalidValueError.of(
                "image_psnr", "none beside object_psnr", self.image_psnr, "choose one"
            )
        if self.ladder and self.object_psnr is None:
            raise InvalidValueError.of(
                "ladder", "object_psnr beside it", "none", "state a PSNR"
            )
        if self.ladder != tuple(sorted(self.ladder, reverse=True)):
            raise InvalidValueError.of(
                "ladder", "the highest PSNR first", self.ladder, "change the order"
            )
        if not self.attributes:
            raise InvalidValueError.of(
                "attributes", "at least one", "none", "say what may change"
            )
        if len(self.eps) not in (1, len(self.attributes)) or len(
            set(self.attributes)
        ) != len(self.attributes):
            expected = (
                f"one number for all of {', '.join(self.attributes)}, or one for each"
            )
            raise InvalidValueError.of(
                "eps", expected, self.eps, "name every attribute once"
            )

    @classmethod
    def for_views(cls, **settings: Any) -> DaggerConfig:
        """The defaults of `mi-splat dagger` from chosen cameras.

        The budget is the PSNR of the object's pixels, 34 dB, and only the colour that a
        Gaussian has from everywhere changes. Where `eps` or `norm` is given and
        `object_psnr` is not, or something else than colours changes, a ball is the
        budget, as in the paper. Its steps are five times longer than the paper's and
        become shorter, with a little momentum: with `relabel(..., strict=True)` this is
        the search of the study of drawn cameras (docs/dagger.md).

        Args:
            settings: Those that are others than the defaults.

        Returns:
            The configuration.
        """
        return cls(**{**views_defaults(settings), **settings})

    @classmethod
    def for_region(cls, **settings: Any) -> DaggerConfig:
        """The defaults for all cameras of a region, whose result held-out views judge.

        Args:
            settings: Those that are others than the defaults.

        Returns:
            The configuration.
        """
        return cls(**{**region_defaults(settings), **settings})

    @classmethod
    def for_narrow(cls, **settings: Any) -> DaggerConfig:
        """The defaults around a chosen camera (`CameraCone`): the PSNR of the object's
        pixels is the budget.

        The images of the search should be changed: `NARROW_CHANGES` has the changes of
        `mi-splat dagger --around`.

        Args:
            settings: Those that are others than the defaults.

        Returns:
            The configuration.
        """
        return cls(**{**narrow_defaults(settings), **settings})

    @property
    def levels(self) -> tuple[DaggerConfig, ...]:
        """The searches of a ladder, one after the other; itself without a ladder."""
        return tuple(
            replace(
                self,
                object_psnr=level,
                ladder=(),
                steps=self.steps if number == 0 else max(1, self.steps // 2),
            )
            for number, level in enumerate(self.ladder)
        ) or (self,)

    @property
    def radius(self) -> dict[str, float]:
        """Radius by attribute."""
        every = self.eps * len(self.attributes) if len(self.eps) == 1 else self.eps
        return dict(zip(self.attributes, every, strict=True))

    @property
    def step(self) -> dict[str, float]:
        """Length of a step by attribute, in the norm."""
        return {
            name: eps * self.step_factor / self.steps
            for name, eps in self.radius.items()
        }

    @property
    def spec(self) -> OptimiserSpec:
        """The optimiser."""
        return optimiser_spec(self.optimiser)

    @property
    def budget(self) -> Budget:
        """Radius and norm as one value."""
        from attacks.search.budget import Budget

        return Budget(radius=self.radius, norm=self.norm)


def views_defaults(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults for chosen cameras beside some settings."""
    attributes = settings.get("attributes", ("sh",))
    has_ball = tuple(attributes) != ("sh",) or bool({"eps", "norm"} & set(settings))
    if has_ball and settings.get("object_psnr") is None:
        return BALL
    return _with_one_psnr(VIEWS, settings)


def narrow_defaults(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults around a chosen camera beside some settings."""
    return _with_one_psnr(NARROW, settings)


def region_defaults(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults for a region of cameras beside some settings."""
    return _with_one_psnr(REGION, settings)


def _with_one_psnr(
    defaults: dict[str, Any], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Defaults without the PSNR of the image where that of the object is given, and the
    other way round.
    """
    kept = dict(defaults)
    if settings.get("object_psnr") is not None:
        kept.pop("image_psnr", None)
    if settings.get("image_psnr") is not None:
        kept.pop("object_psnr", None)
        kept.pop("local_gap", None)
    return kept
