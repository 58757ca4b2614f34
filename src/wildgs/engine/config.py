"""Configuration of training: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from wildgs.errors import UserError
from wildgs.losses.config import ObjectiveConfig
from wildgs.model.config import DropoutConfig, Precision


@dataclass(frozen=True)
class ScheduleConfig:
    """Steps are the paper's, of 30,000; a run of another length scales them (floors keep short runs sane).

    Attributes:
        first_stage: Steps without triplane and depth loss, until the mask is useful.
        densify_from: First densification (3DGS: 500).
        densify_until: Last densification and reset. By default the strategy's: 24,000 for relocation, and 15,000
            (3DGS) for the others.
        densify_every: Between densifications (3DGS: 100); 0 = no densification, pruning and opacity resets.
        reset_every: Between opacity resets; 0 = no resets. By default 3,000 for 3DGS and affine, and none for
            Wild-GS and with the strategy relocation.
        mask_pause: Steps after an opacity reset in which the mask does not learn: the spike in the loss looks
            like a transient.
        sh_every: Between raises of the active SH degree (3DGS: 1,000).
        encoder_every: The photo's encoder learns on one step in so many (not scaled; paper: 1).
        mask_every: The visibility mask learns on one step in so many (not scaled; paper: 1).
        planes_every: The triplane's UNet learns on one step in so many (not scaled; paper: 1).
    """

    first_stage: int = 3000
    densify_from: int = 500
    densify_until: int | None = None
    densify_every: int = 100
    reset_every: int | None = None
    mask_pause: int = 500
    sh_every: int = 1000
    encoder_every: int = 2
    mask_every: int = 2
    planes_every: int = 2

    def __post_init__(self) -> None:
        """Refuses negative steps, and 0 where it means nothing."""
        for name, value in vars(self).items():
            least = 1 if name in ("sh_every", "encoder_every", "mask_every", "planes_every") else 0
            if value is not None and value < least:
                raise UserError(f"schedule.{name} {value}: must be {least} or more")


@dataclass(frozen=True)
class OptimizerConfig:
    """Learning rates of the geometry, 3DGS's; a method has those of its own parameters (`model.learning_rates`).

    Attributes:
        means: Position, at the start, per unit of scene extent.
        means_final: Position, at the end, per unit of scene extent.
        scales: Logarithms of the scales.
        quats: Orientations.
        opacities: Opacity logits.
        short_runs: Rates of positions, scales and orientations are multiplied by (30,000 / steps) to this power in
            runs of fewer than 30,000 steps, for which 3DGS's were chosen. Not in 3DGS.
        batch_scaling: How Adam changes where one of its steps is the mean over K photos (K processes). 'sqrt':
            rates times the square root of K, beta to the power K, eps over the square root of K; 'none': not.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    short_runs: float = 0.25
    batch_scaling: Literal["sqrt", "none"] = "sqrt"


Strategy = Literal["classic", "absgrad", "relocation"]


@dataclass(frozen=True)
class DensityConfig:
    """Which Gaussians are added and taken away. Values are 3DGS's, but for those of relocation.

    Attributes:
        strategy: 'classic' is 3DGS's: clones and splits by screen gradients; 'absgrad' reads absolute gradients
            (AbsGS); 'relocation' splits what covers most error, and takes away what shows nothing. By default
            relocation for Wild-GS, else classic.
        grow_gradient: Mean screen gradient above which a Gaussian grows, per half picture (3DGS's normalised
            device coordinates); absgrad multiplies it by 4.
        split_scale: Gaussians larger than this share of the scene's extent split; smaller ones are cloned.
        prune_opacity: Fainter Gaussians go.
        prune_scale: Gaussians larger than this share of the extent go, once opacities were reset before.
        prune_by_distance: Whether, beyond the extent, that is a share of their distance from the middle: what is
            far may be as large. Not in 3DGS.
        prune_reach: Gaussians that reach further than this share of a picture's longer side go, likewise: most
            of them float right before a camera and stand for what stood in its way; 0 = none. Not in 3DGS.
        reset_opacity: Opacities are lowered to this at a reset.
        reset_unseen: Whether resets also lower those of Gaussians that no photo has shown yet, as 3DGS does: no
            photo would raise them again.
        grow_share: Of relocation: share of the Gaussians that one round splits, and that it takes away, at most.
        grow_error: Of relocation: error that a Gaussian covers, below which it is not split; pixels times error,
            mean over the photos that see it.
        least_pixels: Of relocation: Gaussians that cover fewer pixels of any photo go.
        max_gaussians: Upper bound on the number of Gaussians, from the start.
    """

    strategy: Strategy | None = None
    grow_gradient: float = 2e-4
    split_scale: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.1
    prune_by_distance: bool = True
    prune_reach: float = 0.15
    reset_opacity: float = 0.01
    reset_unseen: bool = False
    grow_share: float = 0.1
    grow_error: float = 0.02
    least_pixels: float = 1.0
    max_gaussians: int = 3_000_000


@dataclass(frozen=True)
class TrainConfig:
    """Training.

    Attributes:
        steps: Training steps (paper: 30,000; '†': 15,000). A step is one photo: K processes take K steps at once.
        seed: Random seed.
        precision: Precision of the networks; 'auto' is bfloat16 where the hardware is fast at it.
        objective: Loss weights.
        schedule: Training schedule.
        optimizer: Learning rates.
        density: Densification and pruning.
        dropout: Dropout of Gaussians, for scenes of few photos.
    """

    steps: int = 30_000
    seed: int = 0
    precision: Precision = "auto"
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    dropout: DropoutConfig = field(default_factory=DropoutConfig)

    def __post_init__(self) -> None:
        """Refuses a run without a step."""
        if self.steps < 1:
            raise UserError(f"steps {self.steps}: must be 1 or more")
