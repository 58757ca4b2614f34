"""Where does a training step's time go, and how much dearer is Wild-GS than plain 3DGS?

    python benchmarks/train_step.py                       100k and 1M Gaussians, 500x375 and 1000x750
    python benchmarks/train_step.py --quick               100k Gaussians, 480x360
    python benchmarks/train_step.py --small               40k Gaussians, 240x180
    python benchmarks/train_step.py --eager               on CUDA: networks without graphs
    python benchmarks/train_step.py --json                a row a line, each as soon as it is measured

The scene is the demo's landmark with its points multiplied to N; both methods start from the same points and
train in turns, so that a noisy machine slows both alike. A step is the mean over as many as the mask's rhythm
has (it learns on every second). Steps are of the second stage, all parts on, with the statistics of densification
gathered and its rounds left out (they come once in a hundred steps and are timed for themselves). Times are
medians over steps. Stages are timed in further steps that carry the clocks: a stage's backward time runs from the
moment its gradient arrives to the moment the next stage's does.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from resized_demo import write_resized_demo
from wildgs.engine.config import DensityConfig, WarpConfig
from wildgs.engine.schedule import MASK_START
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.model.registry import MethodName, method_type
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import default_device
from wildgs.scene import DataConfig, Scene, load_scene

METHODS: tuple[MethodName, ...] = ("3dgs", "wildgs")
SIZES = ((500, 375), (1000, 750))
COUNTS = (100_000, 1_000_000)
PHOTOS = 8
FORWARD_STAGES = (
    ("decode, upload, all else", "wildgs.engine.trainer.Trainer._forward"),
    ("parse", "wildgs.model.wildgs.WildGS.parse"),
    ("project", "wildgs.model.gaussians.Gaussians.project"),
    ("wrap: depth pre-pass and lift", "wildgs.model.wildgs.WildGS.wrap"),
    ("wrap: pictures of the cloud", "wildgs.model.wrapping.project_cloud"),
    ("wrap: triplane UNet", "wildgs.model.unet.UNet.forward"),
    ("sample and embed", "wildgs.model.wrapping.Wrapping.local_embeddings"),
    ("fuse", "wildgs.model.fusion.Fusion.forward"),
    ("harmonics to colours", "wildgs.model.method.sh_to_colors"),
    ("rasterise for the match", "wildgs.model.photo_match.blend_sample"),
    ("rasterise (wildgs)", "wildgs.model.wildgs.blend"),
    ("rasterise (3dgs)", "wildgs.model.method.blend"),
    ("colour match", "wildgs.model.photo_match.match_photo"),
    ("losses", "wildgs.engine.loss_replay.LossReplays.__call__"),
    ("optimiser", "wildgs.engine.optimizers.Optimizers.step"),
    ("densification statistics", "wildgs.engine.density.DensityControl.gather"),
)


@dataclass
class Row:
    """One method at one size."""

    method: str
    device: str
    n: int
    width: int
    height: int
    step_ms: float
    step_min_ms: float
    densify_ms: float
    ratio_to_3dgs: float
    peak_memory_gb: float
    forward_ms: dict[str, float] = field(default_factory=dict)
    backward_ms: dict[str, float] = field(default_factory=dict)


class StageClock:
    """Adds up what every stage takes, without what stages inside it take."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.forward: dict[str, float] = defaultdict(float)
        self.backward: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []
        self._open: str | None = None
        self._stamp = 0.0
        self._hooked: dict[int, Tensor] = {}  # a stage may hand on another's tensors

    def now(self) -> float:
        """Seconds, with the device idle."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def wrap(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time going to a stage."""

        def timed(*arguments: Any, **options: Any) -> Any:
            self._inside.append(0.0)
            start = self.now()
            result = function(*arguments, **options)
            elapsed = self.now() - start
            self.forward[stage] += elapsed - self._inside.pop()
            if self._inside:
                self._inside[-1] += elapsed
            for tensor in _tensors(result):
                if tensor.requires_grad and id(tensor) not in self._hooked:
                    self._hooked[id(tensor)] = tensor
                    tensor.register_hook(lambda _: self._enter(stage))
            return result

        return timed

    def _enter(self, stage: str | None) -> None:
        now = self.now()
        if self._open is not None:
            self.backward[self._open] += now - self._stamp
        self._open, self._stamp = stage, now

    @contextmanager
    def running(self) -> Iterator[None]:
        """Puts the clocks in place."""
        with ExitStack() as stack:
            for stage, target in FORWARD_STAGES:
                owner, name = _resolve(target)
                function = self.wrap(stage, getattr(owner, name))
                stack.enter_context(patch.object(owner, name, function))
            stack.enter_context(patch.object(Tensor, "backward", self._backward(Tensor.backward)))
            yield

    def _backward(self, function: Callable[..., None]) -> Callable[..., None]:
        def timed(*arguments: Any, **options: Any) -> None:
            function(*arguments, **options)
            self._enter(None)
            self._hooked.clear()

        return timed


def _resolve(target: str) -> tuple[Any, str]:
    import importlib

    path, name = target.rsplit(".", 1)
    try:
        return importlib.import_module(path), name
    except ModuleNotFoundError:
        module, owner = path.rsplit(".", 1)
        return getattr(importlib.import_module(module), owner), name


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _tensors(part)
    elif is_dataclass(value):
        for part in vars(value).values():
            yield from _tensors(part)


def make_scene(folder: Path, long_side: int, photos: int = PHOTOS) -> Scene:
    """The demo's landmark."""
    write_resized_demo(folder, photos=photos, long_side=long_side)
    return load_scene(folder, DataConfig(holdout=0))


def make_trainer(
    name: MethodName,
    scene: Scene,
    n: int,
    device: torch.device,
    model: WildGSConfig,
    team: Team | None = None,
    graphs: bool = True,
) -> Trainer:
    """A trainer in the second stage, past the reset at its start after which the mask does not learn."""
    generator = torch.Generator().manual_seed(0)
    source = torch.randint(len(scene.points), (n,), generator=generator)
    noise = 0.02 * torch.randn(n, 3, generator=generator)
    torch.manual_seed(0)
    kind = method_type(name)
    options = model if isinstance(model, kind.Config) else kind.Config()
    method = kind.from_points(options, scene.points[source] + noise, scene.point_colors[source])
    warp = WarpConfig(residuals=False, photos=0)  # as in collections of real photos
    config = TrainConfig(steps=30_000, density=DensityConfig(max_gaussians=n), warp=warp)
    trainer = Trainer(method.to(device), scene, config, team)
    trainer.cuda_graphs = graphs
    trainer.begin()
    schedule = trainer.schedule
    trainer.step = max(schedule.first_stage + schedule.mask_pause, round(MASK_START * config.steps)) + 1
    return trainer


def plain_steps(trainers: dict[MethodName, Trainer], count: int) -> dict[MethodName, list[float]]:
    """Milliseconds of steps, the methods taking turns."""
    seconds: dict[MethodName, list[float]] = defaultdict(list)
    on_cuda = any(trainer.device.type == "cuda" for trainer in trainers.values())
    # Until every photo has been seen, since features of photos are computed once and kept, and on CUDA until every
    # shape of photo has its graph.
    photos = max(len(trainer.views) for trainer in trainers.values())
    warm_up = 20 if on_cuda else -(-photos // 2)
    for index in range(count + warm_up):
        for name, trainer in trainers.items():
            rhythm = trainer.config.schedule.mask_every
            start = time.perf_counter()
            for _ in range(rhythm):
                trainer.advance()
            if trainer.device.type == "cuda":
                torch.cuda.synchronize()
            if index >= warm_up:
                seconds[name].append(1e3 * (time.perf_counter() - start) / rhythm)
    return seconds


def stages_of(trainer: Trainer, count: int) -> StageClock:
    """Milliseconds a step of every stage."""
    clock = StageClock(trainer.device)
    with clock.running():
        for _ in range(count):
            trainer.advance()
    for times in (clock.forward, clock.backward):
        for stage in times:
            times[stage] *= 1e3 / count
    return clock


def densification(trainer: Trainer) -> float:
    """Milliseconds of one round at the budget's limit."""
    start = time.perf_counter()
    trainer.density.densify(
        trainer.method.gaussians, trainer.optimizers.rows, trainer.generator, prune_large=False
    )
    return 1e3 * (time.perf_counter() - start)


def peak_memory(device: torch.device) -> float:
    """Peak so far in GB: of the device, or of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def measure(
    scene: Scene, n: int, count: int, device: torch.device, model: WildGSConfig, graphs: bool = True
) -> list[Row]:
    """One row a method."""
    trainers = {name: make_trainer(name, scene, n, device, model, graphs=graphs) for name in METHODS}
    seconds = plain_steps(trainers, count)
    base = median(seconds["3dgs"])
    rows = []
    for name, trainer in trainers.items():
        clock = stages_of(trainer, trainer.config.schedule.mask_every * max(2, count // 4))
        camera = scene.train_views[0].camera
        times = seconds[name]
        rows.append(
            Row(
                name, str(device), n, camera.width, camera.height, median(times), min(times),
                densification(trainer), median(times) / base, peak_memory(device),
                dict(clock.forward), dict(clock.backward),
            )
        )  # fmt: skip
    return rows


def show(rows: list[Row]) -> None:
    """The tables, for people."""
    for row in rows:
        print(
            f"\n{row.method}  {row.n:,} Gaussians  {row.width}x{row.height}  {row.device}: "
            f"{row.step_ms:.0f} ms a step (least {row.step_min_ms:.0f}), {row.ratio_to_3dgs:.2f} times 3dgs; "
            f"a densification {row.densify_ms:.0f} ms; peak {row.peak_memory_gb:.1f} GB"
        )
        print(f"  {'stage':<32}{'forward':>9}{'backward':>10}")
        for stage in row.forward_ms:
            back = row.backward_ms.get(stage)
            print(f"  {stage:<32}{row.forward_ms[stage]:9.1f}{'' if back is None else f'{back:10.1f}'}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="100k Gaussians at 480x360 alone")
    parser.add_argument(
        "--small", action="store_true", help="40k Gaussians at 240x180 alone, as in docs/study.md"
    )
    parser.add_argument("--json", action="store_true", help="a row a line, and nothing else, on stdout")
    parser.add_argument("--steps", type=int, default=12, help="timed steps a method")
    parser.add_argument("--n", type=int, help="this many Gaussians alone")
    parser.add_argument("--width", type=int, help="this many pixels on the long side alone")
    parser.add_argument("--photos", type=int, default=PHOTOS, help="of the demo's landmark")
    parser.add_argument("--eager", action="store_true", help="on CUDA: networks without graphs")
    options = parser.parse_args()
    device = default_device()
    sizes = ((240, 180),) if options.small else ((480, 360),) if options.quick else SIZES
    if options.width:
        sizes = ((options.width, 0),)
    counts = (40_000,) if options.small else COUNTS[:1] if options.quick else COUNTS
    if options.n:
        counts = (options.n,)
    for width, _ in sizes:
        with tempfile.TemporaryDirectory() as folder:
            scene = make_scene(Path(folder) / "scene", width, options.photos)
            for n in counts:
                rows = measure(scene, n, options.steps, device, WildGSConfig(), graphs=not options.eager)
                if options.json:
                    for row in rows:
                        print(json.dumps(asdict(row)), flush=True)
                else:
                    show(rows)


if __name__ == "__main__":
    main()
