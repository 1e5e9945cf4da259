"""What a point of a study of poisoned training pictures asks for: the settings of its file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from attacks.cloak.config import CameraConfig, EvaluationConfig, SceneConfig, StudyConfig, TrainingConfig
from attacks.cloak.kinds.seen import NO_ATTACK
from attacks.poisons.config import FilterConfig, FrequencyPruningConfig
from attacks.poisons.registry import PoisonConfig, poison_config
from attacks.studies.study_file import Settings, with_none
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Seed, above, check, decode


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim(Checked):
    """What the victim trains on, and can afford; see `attacks.poisons.victim.VictimConfig`."""

    device: Literal["cpu", "cuda"] = "cpu"
    seconds: Annotated[float, above(0, "seconds")] | None = None
    megabytes: Annotated[float, above(0, "MB")] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Defence(Checked):
    """What a victim does who fears poison; one of these.

    Attributes:
        filter: All pictures are filtered before the training, and those that it is compared with are not.
        limit: No more Gaussians than so many times those of the clean splat.
        prune: Gaussians that are too fine for the cameras are taken out of the finished splat.
    """

    filter: FilterConfig | None = None
    limit: Annotated[float, above(0, "times the clean splat's Gaussians")] | None = None
    prune: FrequencyPruningConfig | None = None

    def __post_init__(self) -> None:
        check(self)
        given = [name for name in ("filter", "limit", "prune") if getattr(self, name) is not None]
        if len(given) != 1:
            do = "make each a case of its own"
            raise InvalidValueError.of("defence", "one of filter, limit and prune", given or "none", do)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonPoint:
    """What a point asks for.

    Attributes:
        seed: Of the poison, and of both trainings.
        scene: What is photographed.
        cameras: Where from.
        training: How the victim trains.
        attacker: How the splat is trained that the attacker starts from; None is as the victim does.
        victim: What it trains on, and can afford.
        evaluation: Its `cameras` are those that no training used; of its `confidence` on, a detection counts.
        poison: The attack; None leaves the set as it is.
        defence: What the victim does against it; None is nothing.
        deceive: Classifier that M-IFGSM deceives.
        classifiers: Who says what the object is, in pictures and on splats.
        detectors: Who looks for it there.
    """

    seed: Seed = 0
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    attacker: TrainingConfig | None = None
    victim: Victim = field(default_factory=Victim)
    evaluation: EvaluationConfig = field(default_factory=lambda: EvaluationConfig(cameras=60))
    poison: PoisonConfig | None = None
    defence: Defence | None = None
    deceive: str = ""
    classifiers: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()

    def study(self, training: TrainingConfig) -> StudyConfig:
        """Scene, cameras and a training, in which no look is hidden."""
        return StudyConfig(
            name="poison",
            seeds=(self.seed,),
            scene=self.scene,
            cameras=self.cameras,
            training=training,
            evaluation=self.evaluation,
            attack=NO_ATTACK,
        )


def point_of(settings: Settings, name: str) -> PoisonPoint:
    """What a point asks for."""
    values = with_none(settings)
    table = values.pop("poison", None)
    poison = None if table is None else poison_config(table, f"{name}, poison")
    return replace(decode(PoisonPoint, values, name), poison=poison)
