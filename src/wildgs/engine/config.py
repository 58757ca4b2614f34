"""Configuration of training: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from wildgs.errors import UserError
from wildgs.losses.config import ObjectiveConfig
from wildgs.model.config import DropoutConfig, Precision
from wildgs.priors.config import CELLS, LEAST_SHARE


@dataclass(frozen=True)
class ScheduleConfig:
    """Training schedule. Step counts are for 30,000 steps and are scaled for a run of another length.

    Attributes:
        first_stage: Length of the first stage in steps: no triplane and no depth loss until the mask is useful.
        densify_from: Step of the first densification (3DGS: 500).
        densify_until: Step of the last densification and opacity reset. Default: 24,000 with the strategy
            relocation, 25,000 with mcmc, 15,000 (3DGS) with classic and absgrad.
        densify_every: Steps between densifications; 0 = no densification, pruning or opacity resets. Default: 1,000
            with the strategy relocation, 100 (3DGS) with the others.
        reset_every: Steps between opacity resets; 0 = no resets. Default: 3,000 for 3dgs and affine; 0 for
            wildgs and for the strategies relocation and mcmc.
        mask_pause: Steps after an opacity reset during which the mask is not trained, because it would mistake the
            spike in the loss for a transient.
        sh_every: Steps between increases of the active SH degree (3DGS: 1,000).
        encoder_every: Train the image encoder every n-th step (not scaled; paper: 1).
        mask_every: Train the visibility mask every n-th step (not scaled; paper: 1), after the first 30% of the
            steps in which it is trained, where it learns on every step.
        mask_visits: Average number of times that every photo is seen until masks are final (not scaled; at least
            1,500 steps; 0 = masks are trained in the whole run, as in the paper). In longer training, Gaussians
            slowly learn passers-by, whose masks would then vanish. Masks of a trainable encoder are never final.
        planes_every: Train the triplane's UNet every n-th step (not scaled; paper: 1).
    """

    first_stage: int = 3000
    densify_from: int = 500
    densify_until: int | None = None
    densify_every: int | None = None
    reset_every: int | None = None
    mask_pause: int = 500
    sh_every: int = 1000
    encoder_every: int = 2
    mask_every: int = 2
    mask_visits: int = 20
    planes_every: int = 2

    def __post_init__(self) -> None:
        """Validates the step counts."""
        for name, value in vars(self).items():
            least = 1 if name in ("sh_every", "encoder_every", "mask_every", "planes_every") else 0
            if value is not None and value < least:
                raise UserError(f"--schedule.{name.replace('_', '-')} {value}: must be {least} or more")


@dataclass(frozen=True)
class OptimizerConfig:
    """Learning rates of the geometry, as in 3DGS. Those of a method's other parameters: `model.learning_rates`.

    Attributes:
        means: Initial learning rate of positions, per unit of scene extent.
        means_final: Final learning rate of positions, per unit of scene extent.
        scales: Learning rate of log scales.
        quats: Learning rate of orientations.
        opacities: Learning rate of opacity logits.
        short_runs: In runs of fewer than 30,000 steps, learning rates of positions, scales and orientations are
            multiplied by (30,000 / steps) to this power. 0 = unchanged, as in 3DGS.
        batch_scaling: Adjustment of Adam when a step averages over K photos (K processes). 'sqrt': learning rates
            times the square root of K, beta to the power K, eps divided by the square root of K; 'none': unchanged.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    short_runs: float = 0.25
    batch_scaling: Literal["sqrt", "none"] = "sqrt"


Strategy = Literal["classic", "absgrad", "relocation", "mcmc"]


@dataclass(frozen=True)
class DensityConfig:
    """Densification and pruning of Gaussians. Defaults are those of 3DGS except for the strategy relocation.

    Attributes:
        strategy: 'classic' (3DGS) clones and splits Gaussians with large view-space positional gradients;
            'absgrad' uses absolute gradients (AbsGS); 'relocation' splits the Gaussians that cover most of the
            rendering error and prunes those that contribute least; 'mcmc' (3DGS-MCMC) relocates transparent
            Gaussians, fills the budget and adds noise. Default: relocation for wildgs, else classic.
        grow_gradient: Densify Gaussians whose mean view-space gradient, in normalised device coordinates, exceeds
            this; absgrad uses four times this value.
        split_scale: Gaussians larger than this fraction of the scene extent are split; smaller ones are cloned.
        prune_opacity: Prune Gaussians whose opacity is lower.
        prune_scale: Strategies classic and absgrad: after the first opacity reset, prune Gaussians larger than this
            fraction of the scene extent.
        prune_by_distance: For Gaussians outside the scene extent, relate --density.prune-scale to their distance
            from the scene centre, since distant Gaussians may be larger. Not in 3DGS.
        prune_reach: Strategies classic and absgrad: after the first opacity reset, prune Gaussians whose projected
            radius exceeds this fraction of an image's longer side; most are floaters close to a camera. 0 = off.
            Not in 3DGS.
        reset_opacity: Upper bound to which an opacity reset lowers opacities.
        reset_unseen: Also reset Gaussians that no photo has seen yet, as 3DGS does; no photo would raise their
            opacity again.
        grow_share: Strategy relocation: largest fraction of the Gaussians split at a time.
        prune_share: Strategy relocation: largest fraction of the Gaussians pruned at a time, apart from transparent
            ones.
        grow_error: Strategy relocation: do not split Gaussians that cover less error (sum over pixels, mean over
            the photos that see them).
        least_pixels: Strategy relocation: prune Gaussians that cover fewer pixels in every photo.
        min_visibility: Strategy relocation: ignore the error of pixels whose visibility M is not above this.
        noise_lr: Strategy mcmc: noise on centres as a multiple of their learning rate.
        opacity_reg: Strategy mcmc: weight of the mean opacity in the loss.
        scale_reg: Strategy mcmc: weight of the mean scale, in units of the aligned frame, in the loss.
        max_gaussians: Upper bound on the number of Gaussians, initial ones included.
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
    grow_share: float = 0.2
    prune_share: float = 0.1
    grow_error: float = 0.02
    least_pixels: float = 1.0
    min_visibility: float = 0.8
    noise_lr: float = 5e5
    opacity_reg: float = 0.01
    scale_reg: float = 0.01
    max_gaussians: int = 3_000_000


@dataclass(frozen=True)
class FlatGroundConfig:
    """Gaussians near the ground are kept on its plane (`wildgs.engine.flat_ground`). Not in the paper.

    Attributes:
        rate: Fraction of its distance from the ground plane that a Gaussian moves towards it per step if at most a
            quarter of --flat-ground.photos show it. 0 = off.
        photos: Gaussians that this many training photos show are not moved where the ground is not known to be
            level; the rate falls linearly up to it.
        level: Move all Gaussians near the ground where most of the nearest sparse points are on its plane, those
            that many photos show at a fifth of the rate.
        height: Largest height above the plane of Gaussians that are moved, relative to that of the lowest quarter
            of the cameras (at most 0.12 median depths).
    """

    rate: float = 0.02
    photos: int = 12
    level: bool = True
    height: float = 0.25


@dataclass(frozen=True)
class WarpConfig:
    """Training photos are displaced to where residuals of SfM and renders show them. Not in the paper.

    Attributes:
        residuals: Begin from, and return to, displacements that residuals of structure from motion show. Photos
            whose residuals show none are not displaced at all.
        least_share: Smallest share of the variance of residuals that neighbours must have in common.
        rate: Fraction of an estimated displacement that is applied. 0 = leave photos where residuals show them or,
            without `residuals`, as they are.
        friction: Pixels, of a photo whose longer side is reduced to at most 480, by which displacements decrease
            each time that the photo is used.
        cells: Number of cells along each side of a photo that are displaced independently.
        most: Largest displacement along each axis, relative to the photo's longer side.
        photos: Smallest number of training photos that renders displace. Fewer do not tell where a photo belongs
            from where the scene is.
    """

    residuals: bool = True
    least_share: float = LEAST_SHARE
    rate: float = 0.5
    friction: float = 0.05
    cells: int = CELLS
    most: float = 0.01
    photos: int = 16


@dataclass(frozen=True)
class TrainConfig:
    """Training.

    Attributes:
        steps: Training steps (paper: 30,000; '†': 15,000). One photo is one step: K processes take K steps at a
            time.
        seed: Random seed.
        precision: Precision of the networks; 'auto' uses bfloat16 on hardware that accelerates it.
        objective: Loss weights.
        schedule: Training schedule.
        optimizer: Learning rates of the geometry.
        density: Densification and pruning.
        dropout: Dropout of Gaussians, for scenes of few photos.
        flat_ground: The ground is kept flat.
        warp: Training photos are displaced to where they fit their renders.
    """

    steps: int = 30_000
    seed: int = 0
    precision: Precision = "auto"
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    dropout: DropoutConfig = field(default_factory=DropoutConfig)
    flat_ground: FlatGroundConfig = field(default_factory=FlatGroundConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)

    def __post_init__(self) -> None:
        """Validates the number of steps."""
        if self.steps < 1:
            raise UserError(f"--steps {self.steps}: must be 1 or more")
