"""Training on CUDA: it goes as on the CPU, with graphs as without, and its states open anywhere.

Where there is no GPU, `test_pretended_cuda` trains on a device that says it is one.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.engine.conftest import SIDE
from wildgs.engine.config import DensityConfig, WarpConfig
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.model.registry import MethodName, create_method, restore_method
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.scene import Scene

pytestmark = [pytest.mark.cuda, pytest.mark.filterwarnings("ignore:no ImageNet weights")]

CONFIG = TrainConfig(
    steps=60, precision="float32", density=DensityConfig(grow_gradient=1e-5, max_gaussians=900)
)
STEPS = 26


def trainer_on(
    device: str,
    scene: Scene,
    model: WildGSConfig,
    method: MethodName = "wildgs",
    config: TrainConfig = CONFIG,
    *,
    cuda_graphs: bool = True,
) -> Trainer:
    torch.manual_seed(0)
    made = create_method(method, model if method == "wildgs" else None, scene)
    trainer = Trainer(made.to(device), scene, config)
    trainer.schedule.densify_from, trainer.schedule.densify_every = 3, 5
    trainer.cuda_graphs = cuda_graphs
    trainer.begin()
    return trainer


def losses_of(trainer: Trainer, steps: int) -> list[float]:
    return [float(trainer.advance().losses.total.detach()) for _ in range(steps)]


@pytest.mark.parametrize("method", ["3dgs", "wildgs"])
def test_training_goes_as_on_the_cpu(wall_scene: Scene, tiny_model: WildGSConfig, method: MethodName):
    cpu = trainer_on("cpu", wall_scene, tiny_model, method)
    cuda = trainer_on("cuda", wall_scene, tiny_model, method)
    wanted, found = losses_of(cpu, STEPS), losses_of(cuda, STEPS)
    # Convolutions round to TF32 on GPUs, and differences grow from step to step; what is learnt stays.
    assert found[:2] == pytest.approx(wanted[:2], rel=2e-3)
    # Densification, from step 5 on, draws other random numbers on another device.
    assert found[:5] == pytest.approx(wanted[:5], rel=0.05)
    assert sum(found[-12:]) == pytest.approx(sum(wanted[-12:]), rel=0.25)
    assert len(cpu.method.gaussians) > len(wall_scene.points)
    assert len(cuda.method.gaussians) == pytest.approx(len(cpu.method.gaussians), rel=0.05)


def test_photos_are_displaced_as_on_the_cpu(wall_scene: Scene, tiny_model: WildGSConfig):
    warp, schedule = (
        WarpConfig(residuals=False, photos=0, friction=0.0, most=0.1),
        ScheduleConfig(first_stage=0),
    )
    grids = {}
    for device in ("cpu", "cuda"):
        config = replace(CONFIG, warp=warp, schedule=schedule)
        trainer = trainer_on(device, wall_scene, tiny_model, config=config)
        losses_of(trainer, 4)
        grids[device] = SIDE * trainer.warps.grids.cpu()
    assert int(grids["cpu"].flatten(1).any(dim=1).sum()) == 4
    # In pixels; the renders differ by the rounding of convolutions.
    torch.testing.assert_close(grids["cuda"], grids["cpu"], atol=0.02, rtol=0)


def test_graphs_change_nothing_but_speed(wall_scene: Scene, tiny_model: WildGSConfig):
    found = {}
    for graphs in (False, True):
        config = replace(CONFIG, precision="bfloat16")
        trainer = trainer_on("cuda", wall_scene, tiny_model, config=config, cuda_graphs=graphs)
        found[graphs] = losses_of(trainer, 22)
        method = trainer.method
        assert isinstance(method, WildGS)
        assert (method.parsing.replays.recorded > 0) is graphs
        assert (method.wrapping.replays.recorded > 0) is graphs
    assert found[True][:4] == pytest.approx(found[False][:4], rel=2e-3)
    assert sum(found[True]) == pytest.approx(sum(found[False]), rel=0.1)


def test_a_state_of_cuda_goes_on_there_and_opens_on_the_cpu(wall_scene: Scene, tiny_model: WildGSConfig):
    trainer = trainer_on("cuda", wall_scene, tiny_model)
    losses_of(trainer, 14)
    kept = {name: value.detach().cpu().clone() for name, value in trainer.state().items()}
    pictures, further = {}, {}
    for device in ("cpu", "cuda"):
        state = {name: value.clone() for name, value in kept.items()}
        parameters = {name[7:]: value for name, value in state.items() if name.startswith("method.")}
        method = restore_method("wildgs", tiny_model, parameters).to(device)
        view = wall_scene.test_views[0]
        photo, camera = (view.read_photo().float() / 255).to(device), view.camera.to(device)
        with torch.no_grad():
            sh = method.shade(method.encode(photo, camera))
            pictures[device] = method.render(camera, sh).colors.cpu()
        resumed = Trainer(method, wall_scene, CONFIG)
        resumed.restore(state)
        resumed.begin()
        further[device] = losses_of(resumed, 7)
    torch.testing.assert_close(pictures["cuda"], pictures["cpu"], atol=5e-3, rtol=0)
    assert further["cuda"][:2] == pytest.approx(further["cpu"][:2], rel=0.01)
    assert sum(further["cuda"]) == pytest.approx(sum(further["cpu"]), rel=0.2)
