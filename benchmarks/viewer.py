"""What does `wildgs train --view` cost? Steps with and without the viewer, alternating in one training.

Example: wildgs demo --output wildgs-demo && python benchmarks/viewer.py wildgs-demo/wildgs

A run is trained on from its checkpoint (nothing is written). Blocks of time with the viewer's turns alternate with
blocks without (A B B A ...), so that growing scenes and a busy machine weigh on both. Somebody looks all the time,
moves the slider and visits photos, and a process takes in all that a browser would. A browser's own work is not
counted; on a laptop without a GPU it draws with the same processor.
"""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from wildgs.engine.report import StepReport
from wildgs.engine.trainer import Trainer
from wildgs.runs import load_run, resume_training
from wildgs.viewer.jobs import TrainingTurns
from wildgs.viewer.serving import ServerConfig, open_server
from wildgs.viewer.subject import TrainingSubject
from wildgs.viewer.viewer import Viewer, ViewerConfig

AUDIENCE = """
import sys
from websockets.sync.client import connect
with connect(sys.argv[1], subprotocols=[sys.argv[2]], max_size=None) as socket:
    for _ in socket:
        pass
"""
LONGER = 5


@dataclass(frozen=True)
class Command:
    """Measures the viewer's part of training time."""

    run: tyro.conf.Positional[Path]
    """Run folder; its scene must be there too."""
    blocks: int = 8
    """Blocks of each kind, an even number."""
    block_seconds: float = 30.0
    """Length of a block."""


@dataclass
class Tally:
    """Steps and what they took, of one kind of block."""

    steps: int = 0
    wall: float = 0.0
    processor: float = 0.0


class EnoughError(Exception):
    """All blocks are done."""


@dataclass
class Alternation:
    """An observer that lets the viewer have its turns in every second block, in the order A B B A."""

    turns: TrainingTurns
    viewer: Viewer
    command: Command
    block: int = -1

    def __post_init__(self) -> None:
        self.current = Tally()
        self.done: list[tuple[bool, Tally]] = []
        self._start()

    @property
    def on(self) -> bool:
        """Whether the viewer has its turns in this block."""
        return self.block % 4 in (0, 3)

    def _start(self) -> None:
        self.block += 1
        self.current = Tally()
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def __call__(self, report: StepReport) -> None:
        """Counts a step."""
        if self.on:
            self._be_busy(report.step)
            self.turns(report)
        self.current.steps += 1
        self.current.wall = time.perf_counter() - self._wall
        if self.current.wall >= self.command.block_seconds:
            self.current.processor = time.process_time() - self._processor
            self.done.append((self.on, self.current))
            if len(self.done) == 2 * self.command.blocks:
                raise EnoughError
            self._start()

    def _be_busy(self, step: int) -> None:
        """Somebody who never stops asking."""
        self.viewer.lighting.set_amount((step % 21) / 20)
        if step % 10 == 0:
            views = self.viewer.subject.views
            self.viewer.photos.visit(None, views[step // 10 % len(views)])


def total(done: list[tuple[bool, Tally]], on: bool) -> Tally:
    chosen = [tally for kind, tally in done if kind == on]
    return Tally(*(sum(getattr(t, name) for t in chosen) for name in ("steps", "wall", "processor")))


def trainer_of(folder: Path) -> tuple[Trainer, TrainingSubject]:
    run = load_run(folder)
    scene = run.read_scene()
    trainer = resume_training(folder, scene)
    longer = Trainer(trainer.method, scene, replace(trainer.config, steps=LONGER * max(trainer.step, 1)))
    longer.restore(trainer.state())
    return longer, TrainingSubject(longer, scene)


def main(command: Command) -> None:
    import viser

    trainer, subject = trainer_of(command.run)
    server = open_server(ServerConfig(port=0), "benchmark")
    viewer = Viewer(server, subject, ViewerConfig())
    protocol = f"viser-v{viser.__version__}"
    address = f"ws://127.0.0.1:{server.get_port()}/{server.access.token}"
    audience = subprocess.Popen([sys.executable, "-c", AUDIENCE, address, protocol])
    turns = TrainingTurns(viewer.jobs, lambda: audience.poll() is None, lambda _: viewer.ask_for_update())
    alternation = Alternation(turns, viewer, command)
    try:
        trainer.run([alternation])
    except EnoughError:
        pass
    finally:
        watched = audience.poll() is None
        audience.terminate()
        viewer.close()
    if not watched:
        sys.exit("nobody looked: the audience was refused")
    with_viewer, without = total(alternation.done, True), total(alternation.done, False)
    print(f"{command.run}: {len(trainer.method.gaussians):,} Gaussians, {trainer.device}")
    for name, tally in (("with the viewer", with_viewer), ("without", without)):
        if not tally.steps:
            sys.exit("a kind of block saw no step; give more or longer blocks")
        print(
            f"  {name:<16} {tally.steps:5d} steps, {1000 * tally.wall / tally.steps:7.1f} ms wall and "
            f"{1000 * tally.processor / tally.steps:7.1f} ms of processor time a step"
        )
    wall = (with_viewer.wall / with_viewer.steps) / (without.wall / without.steps)
    processor = (with_viewer.processor / with_viewer.steps) / (without.processor / without.steps)
    print(f"  turns took {turns.seconds / with_viewer.wall:.1%} of the trainer's time in their blocks")
    print(
        f"  ratio, with : without: {wall:.3f} wall, {processor:.3f} processor time (promised: at most 1.050)"
    )


if __name__ == "__main__":
    main(tyro.cli(Command))
