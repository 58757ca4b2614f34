"""The training loop, without output of its own: observers are called after every step."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs import features
from wildgs.engine.config import TrainConfig
from wildgs.engine.consensus import Consensus
from wildgs.engine.density import STRATEGIES, DensityReport, SeenView
from wildgs.engine.feed import PhotoFeed, ViewSampler
from wildgs.engine.flat_ground import FlatGround
from wildgs.engine.foregrounds import Foregrounds
from wildgs.engine.loss_replay import LossReplays
from wildgs.engine.optimizers import Optimizers, sort_rows
from wildgs.engine.photo_counts import PhotoCounts
from wildgs.engine.process_settings import ProcessSettings
from wildgs.engine.report import Observer, StepReport
from wildgs.engine.safety import StepGuard
from wildgs.engine.schedule import Schedule
from wildgs.engine.team import Team, same_everywhere
from wildgs.engine.warps import PhotoWarps
from wildgs.errors import UserError, WildGSWarning
from wildgs.losses.objective import Losses
from wildgs.model.method import Method
from wildgs.model.parsing import FeatureCache, keep_features
from wildgs.model.precision import (
    choose_precision,
    lay_out_channels_last,
    set_precision,
    switch_replays,
)
from wildgs.model.training_pass import SeenPhoto, TrainingOutput
from wildgs.progress import Counter
from wildgs.scene import Scene, View, scene_extent

PREPARATION_PHOTOS = 16
FEATURE_CACHE_BYTES = 10**9


class Trainer:
    """Trains a method on a scene's training photos.

    Attributes:
        consensus: What may be transient in the training photos, as far as they have been compared.
        foregrounds: What training photos show in free space.
        photo_counts: How many photos show each Gaussian, and hence how often it is dropped.
        warps: Displacements of the training photos.
        on_compared_photo: Called with (photos done, total number of photos) when the photos are compared.
        on_final_photo: Called with (photos done, total number of photos) during `Method.finish` after the last
            step.
        cuda_graphs: Whether networks are captured and replayed as CUDA graphs (on CUDA devices).
        feature_cache: Memory for a frozen encoder's features of training photos, bytes.
        skips_on_device: Whether non-finite steps are skipped without synchronisation.
    """

    def __init__(self, method: Method, scene: Scene, config: TrainConfig, team: Team | None = None) -> None:
        """Prepares training at step 0.

        Args:
            method: The method, which is trained in place on the device of its parameters.
            scene: The scene; its ground truth is not used.
            config: Training options.
            team: The processes that train this model. Default: this process alone.

        Raises:
            UserError: There are no training photos, or fewer than processes.
        """
        self.views = scene.train_views
        self._scene = scene
        self.team = team or Team()
        if not self.views:
            raise UserError(
                f"{scene.root}: no training photo has a camera; change the split or the COLMAP model"
            )
        if len(self.views) < self.team.size:
            raise UserError(
                f"{scene.root}: {len(self.views)} training photos are too few for {self.team.size} processes; "
                f"use at most {len(self.views)}"
            )
        self.method = method
        self.config = config
        self.device = method.gaussians.means.device
        self.step = 0
        self.seconds = 0.0
        strategy = STRATEGIES[config.density.strategy or method.density]
        resets = method.reset_every if strategy.resets else 0
        photos = len(self.views) if method.masks_become_final else None
        self.schedule = Schedule(
            config.schedule, config.steps, resets, strategy.until, photos, strategy.every
        )
        lay_out_channels_last(method)
        extent = scene_extent(scene)
        self.optimizers = Optimizers.build(method, config.optimizer, extent, self.team.size, config.steps)
        self.density = strategy(config.density, extent, len(method.gaussians), self.device)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.sampler = ViewSampler(len(self.views), self.generator)
        self.feed = PhotoFeed(self.views, self.sampler, self.team, self.device, scene)
        objective = config.objective
        if not method.sky_depth:  # nothing need be behind the scene
            objective = replace(objective, opaque_weight=0.0)
        self._objective = objective
        evident = self.schedule.mask_steps if objective.mask_gradient == "evidence" else 0
        self.consensus = Consensus(self.device, len(self.views), evident if objective.consensus else 0)
        self.foregrounds = Foregrounds(scene, self.device, evident if objective.free_space else 0)
        self.flat_ground = FlatGround(method, scene, config.flat_ground)
        self.photo_counts = PhotoCounts(method, config.dropout, config.steps, needed=self.flat_ground.is_used)
        begin = self.schedule.first_stage
        self.warps = PhotoWarps(
            self.views, config.warp, begin, self.device, scene.residuals, used=method.warps_photos
        )
        self.guard = StepGuard()
        self.loss = LossReplays()
        self.skips_on_device = self.device.type == "cuda" and features.is_on("skip_on_device")
        self._process = ProcessSettings(self.device)
        self.on_final_photo: Counter = lambda done, total: None
        self.on_compared_photo: Counter = lambda done, total: None
        self.cuda_graphs = True
        self.feature_cache = FEATURE_CACHE_BYTES

    def run(self, observers: Sequence[Observer] = ()) -> None:
        """Trains until `config.steps`; every observer is called after every step.

        Raises:
            TrainingDivergedError: Too many consecutive steps had a non-finite loss or gradient.
        """
        try:
            self.begin()
            while self.step < self.config.steps:
                report = self.advance()
                if self.step >= self.config.steps:
                    self._report_marked()
                    self._finish()
                for observer in observers:
                    observer(report)
        finally:
            self.end()

    def begin(self) -> None:
        """Prepares the method and this process for `advance`; called by `run` and undone by `end`.

        Raises:
            UserError: Photos, models or versions differ between the ranks.
        """
        self._process.begin()
        precision = choose_precision(self.config.precision, self.device)
        self.team.require_same(same_everywhere(self.method, self.views, self.config, precision))
        if self.step == 0:
            with self.team.propagate_errors():
                self._prepare()
        self.team.share([*self.method.state_dict().values(), *self.warps.tensors()])
        set_precision(self.method, precision)
        switch_replays(self.method, self.cuda_graphs)
        self.loss.switch(self.cuda_graphs)
        self.warps.replays.switch(self.cuda_graphs)
        keep_features(self.method, FeatureCache(self.feature_cache))

    def end(self) -> None:
        """Undoes `begin`: float32, no CUDA graphs, and the previous settings of the process."""
        set_precision(self.method, torch.float32)
        switch_replays(self.method, False)
        self.loss.switch(False)
        self.warps.replays.switch(False)
        keep_features(self.method, None)
        self._process.end()

    def advance(self) -> StepReport:
        """Takes one step with one photo per rank."""
        start = time.perf_counter()
        if self.consensus.is_missing(self.step, self.team.size):
            self.consensus.compare(self.method, self._scene, self.feed, self.on_compared_photo)
        self.photo_counts.update(self.step, self.feed)
        view = self.feed.next_view()
        self.optimizers.set_progress(self.schedule.progress(self.step))
        photo, keep = self.feed.photo(view)
        target = self.warps.warped(view, photo)
        sky = self._sky(view)
        output, losses = self._forward(view, photo, keep, sky, target)
        self.warps.update(view, target, output.picture.detach(), self.step, self.team)
        seen = None
        if self.schedule.gathers(self.step) and self.density.measures(self.step // self.team.size):
            static = self._static_pixels(output, keep, sky)
            seen = SeenView(
                output.projection, output.rendering.colors, output.painted, target, static, output.developed
            )
            seen = self.density.before_backward(seen)
        skipped = self._report_marked()
        if self.density.perturbs:
            penalty = self.density.regularizer(self.method.gaussians, self.method.growable())
            losses = replace(losses, total=losses.total + penalty)
        losses.total.backward()
        losses = self.team.average(self.optimizers.parameters(), losses)
        skipped = self._take(seen, losses) or skipped
        before = self.step
        self.step = min(before + self.team.size, self.config.steps)
        taken = self.step - before
        self.flat_ground.update(self.step, taken)
        density = self._control_density(taken)
        self.seconds += time.perf_counter() - start
        return StepReport(
            step=self.step,
            view=view,
            losses=losses.detached(),
            rendering=output.rendering.detached(),
            visibility=None if output.visibility is None else output.visibility.detach(),
            num_gaussians=len(self.method.gaussians),
            density=density,
            seconds=self.seconds,
            skipped=skipped,
            taken=taken,
        )

    def _step(self, faulty: Float[Tensor, ""] | None = None) -> None:
        """Takes the optimisers' step and lets density control perturb the result."""
        self.optimizers.step(faulty)
        if self.density.perturbs:
            growable = self.method.growable()
            self.density.perturb(self.method.gaussians, self.optimizers.means_rate, self.generator, growable)

    def _take(self, seen: SeenView | None, losses: Losses) -> str | None:
        """Takes the optimisers' step if it is finite; returns why it was skipped, if already known."""
        if self.skips_on_device:
            faulty = self.guard.mark(self.step + 1, self.feed.batch, losses, self.optimizers.parameters())
            if seen is not None:
                self.density.gather(seen, self.team.pool, faulty == 0)
            self._step(faulty)
            return None
        fault = self.guard.judge(self.feed.batch, losses, self.optimizers.parameters())
        if fault is None:
            if seen is not None:
                self.density.gather(seen, self.team.pool)
            self._step()
        else:
            self.method.zero_grad(set_to_none=True)
            with self.team.propagate_errors():
                self.guard.report(self.step + 1, fault, self.method)
        return fault

    def _static_pixels(
        self, output: TrainingOutput, keep: Bool[Tensor, "H W"] | None, sky: Bool[Tensor, "H W"] | None
    ) -> Bool[Tensor, "H W"] | None:
        """Pixels that are neither transient nor masked by the user nor sky, which does not grow; None for all."""
        masks = [] if keep is None else [keep]
        if output.visibility is not None:
            masks.append(output.visibility > self.config.density.min_visibility)
        if sky is not None:
            masks.append(~sky)
        return reduce(torch.logical_and, masks) if masks else None

    def _sky(self, view: View) -> Bool[Tensor, "H W"] | None:
        """Pixels that certainly show sky; None if Gaussians may be in front of it."""
        used = self.method.sky_depth and self.config.objective.sky_weight
        return self.feed.sky(view) if used else None

    def _report_marked(self) -> str | None:
        """Reports the previous step if the GPU, which has finished it by now, skipped it; returns the reason."""
        found = self.guard.judge_marked()
        if found is None:
            return None
        with self.team.propagate_errors():
            self.guard.report(*found, self.method)
        return found[1]

    def _forward(
        self,
        view: View,
        photo: Float[Tensor, "H W 3"],
        keep: Bool[Tensor, "H W"] | None,
        sky: Bool[Tensor, "H W"] | None,
        target: Float[Tensor, "H W 3"] | None = None,
    ) -> tuple[TrainingOutput, Losses]:
        """Encodes and renders a photo, and compares the render with it or, if given, with the displaced photo."""
        stage = self.schedule.stage(self.step, self.method.sh_degree, self.team.size)
        rates, neighbours = self.photo_counts.dropout_rates(), self.config.dropout.neighbours
        stage = replace(stage, dropout=rates, neighbours=neighbours, absgrad=self.density.absgrad)
        output = self.method.training_pass(photo, self.feed.camera(view), stage, keep, name=view.name)
        supervised = self.method.depth_supervised and stage.explicit
        losses = self.loss(
            self._objective,
            self.schedule.mask_progress(self.step),
            photo if target is None else target,
            output.picture,
            visibility=output.visibility,
            keep=keep,
            depth=output.rendering.depth,
            alpha=output.rendering.alpha,
            disparity=self.feed.disparity(view) if supervised else None,
            metric_depth=self.feed.depth(view) if self.method.depth_supervised else None,
            sky=sky,
            sky_depth=self.method.sky_depth,
            observations=self.feed.observations(view),
            static=sky if self.feed.tells_sky_from_walls(view) else None,
            train_mask=stage.learn_mask,
            mask_threshold=self.method.mask_threshold,
            num_photos=len(self.views),
            doubt=self.consensus.doubt(view.name),
            foreground=None if output.visibility is None else self.foregrounds.of(view.name, self.step),
        )
        if output.visibility is not None:
            self.consensus.observe(output.visibility, self.step)
        return output, losses

    def _control_density(self, taken: int) -> DensityReport | None:
        report = None
        # Before densification, because its new Gaussians count as unseen.
        if self.schedule.resets(self.step, taken):
            self.density.reset_opacity(self.method.gaussians, self.optimizers.rows, self.method.growable())
        if self.schedule.densifies(self.step, taken):
            large = 0 < self.schedule.reset_every < self.step
            report = self.density.densify(
                self.method.gaussians,
                self.optimizers.rows,
                self.generator,
                prune_large=large,
                growable=self.method.growable(),
                sort=True,
            )
        return report

    def shrink_to_budget(self) -> int:
        """Prunes Gaussians if `density.max_gaussians` was lowered; returns their number."""
        budget = self.config.density.max_gaussians
        excess = self.density.shrink(self.method.gaussians, self.optimizers.rows, budget)
        if excess:
            self.method.finish(())
            if self.step >= self.config.steps:
                self._finish()
        return excess

    def _prepare(self) -> None:
        """Sorts the Gaussians in Morton order and calls `Method.prepare` with a few photos."""
        sort_rows(self.method.gaussians, self.optimizers.rows)
        stride = max(1, len(self.views) // PREPARATION_PHOTOS)
        chosen = [view for view in self.views[::stride][:PREPARATION_PHOTOS] if self.feed.is_readable(view)]
        self.method.prepare([self.feed.photo(view)[0] for view in chosen])

    def _finish(self) -> None:
        """Calls `Method.finish` with some training photos."""
        start = time.perf_counter()
        switch_replays(self.method, False)
        self.method.finish(self._final_photos())
        self.seconds += time.perf_counter() - start

    def _final_photos(self) -> Iterator[SeenPhoto]:
        count = min(self.method.final_photos(), len(self.views))
        for number in range(count):
            view = self.views[number * len(self.views) // count]
            if self.feed.is_readable(view):
                photo, keep = self.feed.photo(view)
                yield SeenPhoto(photo, self.feed.camera(view), keep, view.name)
            self.on_final_photo(number + 1, count)

    def state(self) -> dict[str, Tensor]:
        """The complete state of training by name, sufficient to continue bitwise identically."""
        state = {f"method.{name}": value for name, value in self.method.state_dict().items()}
        state |= {f"optimizer.{name}": value for name, value in self.optimizers.state().items()}
        state |= {f"sampler.{name}": value for name, value in self.sampler.state().items()}
        state |= {f"density.{name}": value for name, value in self.density.state().items()}
        state["random.generator"] = self.generator.get_state()
        state |= {f"random.{name}": value for name, value in self._process.random_states().items()}
        state["progress.step"] = torch.tensor(self.step)
        state["progress.seconds"] = torch.tensor(self.seconds, dtype=torch.float64)
        state["progress.skipped"] = torch.tensor(self.guard.skipped)
        state["progress.hidden"] = self.consensus.state()
        state |= {f"dropout.{name}": value for name, value in self.photo_counts.state().items()}
        state |= {f"warps.{name}": value for name, value in self.warps.state().items()}
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues from `state`; the method must be restored from the same checkpoint before."""
        self.optimizers.restore(_under(state, "optimizer."))
        if not self.sampler.restore(_under(state, "sampler.")):
            message = (
                "the training photos have changed since the run was started;"
                f" it continues with the current {len(self.views)}"
            )
            warnings.warn(message, WildGSWarning, stacklevel=2)
        self.density.restore(_under(state, "density."))
        self.generator.set_state(state["random.generator"])
        self._process.set_random_states(_under(state, "random."))
        self.step = int(state["progress.step"])
        self.seconds = float(state["progress.seconds"])
        self.guard.skipped = int(state.get("progress.skipped", 0))
        self.consensus.restore(state.get("progress.hidden", torch.zeros(3)))
        self.photo_counts.restore(_under(state, "dropout."))
        self.warps.restore(_under(state, "warps."))
        if self.step < self.config.steps:
            self.method.finish(())


def _under(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
