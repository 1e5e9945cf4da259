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
"""What happens to images during such a search, as `ImageTransformations` has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig:
    """How to attack; the defaults of the class are those of the paper's text.

    `for_views` has the defaults of `mi-splat dagger`, and `for_region` those for a
    region of cameras.

    Attributes:
        attributes: Attributes to perturb: means, scales, rotations, opacities or sh of
            the object's Gaussians, its pose (shift, turn), its shape (lattice), or a
            threat registered by a plug-in.
        eps: Perturbation budget epsilon in the units of the splat file: one for all
            attributes, or one for each.
        norm: Norm of the budget: over the whole object (linf, l2), or for each
            Gaussian.
        steps: Number of steps.
        step_factor: The first step is eps * step_factor / steps long.
        optimiser: Optimiser: pgd, fgsm, momentum, adam, apgd, cw (penalises the
            perturbation), square and random (black-box), or one registered by a
            plug-in.
        momentum: Momentum: share of the earlier gradients kept at each step; none for
            the optimiser's own (0 for pgd).
        schedule: Schedule of the step size (pgd, momentum, adam).
        gradient_power: Power of the gradients' absolute values before a step of pgd or
            momentum, in [0, 1]; below 1, small ones count for more (see
            `attacks.optimisers.methods.momentum`).
        required_views: Fraction of the views in which the attack has to succeed against
            every detector.
        controls: Random-perturbation controls: white noise of the same PSNR on the
            object's pixels (noise), smooth noise of that PSNR (smooth-noise), or white
            noise of the same norm (norm-noise), which averages out and changes pixels
            much less.
        noise_draws: Draws of each control.
        sh_degree: Highest SH degree to perturb; missing coefficients are added and
            start at 0. 3 is the degree of 3DGS and of the paper; 0 changes a Gaussian's
            colour equally from all directions; none keeps the scene's own.
        restarts: Number of runs; the first starts at the clean object, the others at
            random points within the budget.
        random_start: Start the first run at a random point within the budget, too.
        early_stop: Whether the first unambiguous success from chosen cameras ends the
            search. --no-early-stop: take every step of every run, even after a success.
        isolated: Optimise the object in isolation, on the renderer's background, as the
            paper's code does. The result is still evaluated in the scene.
        sequential: Attack several cameras sequentially, each starting from the result
            of the previous one, as in the paper's code, instead of jointly.
        image_psnr: Minimum PSNR of the images in dB, over the views that select the
            best step. The search then penalises their squared error
            (`attacks.dagger.search`); eps remains a second bound.
        object_psnr: PSNR budget in dB over the pixels of which at least half is the
            object's. The final perturbation is scaled to exactly this PSNR.
        local_gap: How far in dB the PSNR of any part of the object may be below
            object_psnr, so that no single part carries the whole change; a part is a
            square window, a sixth of the object's box wide. Default: no limit.
        ladder: Values of object_psnr to try in turn, the highest first, each starting
            from the previous result. The result is the first at which the attack
            succeeds in the validation views, or the last. Levels after the first take
            half the steps.
        batch: Views per step, out of the cameras (0 for all of them) or of a region's
            pool.
        pool: Number of training views of a region; 0 draws new ones at each step.
        validation: Number of separate validation views of a region that select the best
            step. With chosen cameras, these are used themselves.
        validate_every: Steps between validations; if every step uses all cameras, each
            step is validated.
        stop_at: Fraction of successful validation views of a region at which the search
            ends. Default: every step is taken.
        held_out: Number of held-out views on which the result of a region is evaluated.
        seed: Random seed of starting points, training and validation views, and noise.
        held_out_seed: Seed of the held-out views of a region (differs from --seed).

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
    isolated: bool = False
    sequential: bool = False
    image_psnr: (
        Annotated[float, above(0, "dB", "26 is clearly visible, 40 barely")] | None
    ) = None
    object_psnr: (
        Annotated[float, above(0, "dB", "34 is visible next to the clean object")]
        | None
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
    held_out_seed: Seed = 1000

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
                "image_psnr", "none with object_psnr", self.image_psnr, "choose one"
            )
        if self.ladder and self.object_psnr is None:
            raise InvalidValueError.of(
                "ladder", "object_psnr as well", "none", "state a PSNR"
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
        """The defaults for all cameras of a region, evaluated on held-out views.

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
