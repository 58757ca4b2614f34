"""The contract that every registered method keeps, and the example of docs/methods.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.engine.conftest import build_wall_scene
from wildgs.config import RunConfig
from wildgs.engine.config import DensityConfig
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError
from wildgs.light.look import look_of, mix
from wildgs.light.photos import encode_view, make_atlas
from wildgs.light.saved import load_look, save_look
from wildgs.model import registry
from wildgs.model.appearance import Embeddings
from wildgs.model.config import InitialConfig, ParsingConfig, SkyConfig, WrappingConfig
from wildgs.model.gaussians import GEOMETRY_ROWS
from wildgs.model.method import Method
from wildgs.model.registry import METHODS, create_method, method_type, restore_method
from wildgs.model.training_pass import Stage
from wildgs.presets import with_preset
from wildgs.scene import Scene

pytestmark = pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")

DOCS = Path(__file__).parents[1] / "docs/methods.md"
SKY = SkyConfig(points=20)
SMALL: dict[str, dict[str, Any]] = {
    "wildgs": {
        "sky": SKY,
        "parsing": ParsingConfig(max_side=32),
        "wrapping": WrappingConfig(resolution=16, features=8, widths=(8, 8)),
    },
    "affine": {"initial": InitialConfig(sky=SKY), "encode_steps": 8},
}
"""Options that make a method quick; a method without an entry runs with its defaults."""
TRAIN = TrainConfig(
    steps=30,
    precision="float32",
    schedule=ScheduleConfig(densify_from=1, densify_every=7500, first_stage=1),
    density=DensityConfig(max_gaussians=1000, grow_gradient=1e-9),
)


def small_config(name: str) -> Any:
    return method_type(name).Config(**SMALL.get(name, {}))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_wall_scene()


@pytest.fixture(scope="module", params=list(METHODS))
def trained(request: pytest.FixtureRequest, scene: Scene) -> Trainer:
    torch.manual_seed(0)
    made = create_method(request.param, small_config(request.param), scene, max_gaussians=1000)
    trainer = Trainer(made, scene, TRAIN)
    trainer.run()
    trainer.method.eval()
    return trainer


def embeddings_of(method: Method, scene: Scene, index: int) -> Embeddings:
    with torch.no_grad():
        return method.embed(encode_view(method, scene.views[index]))


def test_what_it_declares_is_what_it_has(trained: Trainer) -> None:
    method = trained.method
    assert method_type(method.name) is type(method)
    assert isinstance(method.config, method.Config)
    shapes = {name: tuple(values.shape[1:]) for name, values in method.gaussians.rows.items()}
    assert shapes == method.rows(method.config)
    assert GEOMETRY_ROWS.items() <= shapes.items()
    assert method.row_rates().keys() == shapes.keys() - GEOMETRY_ROWS.keys()
    rows = {id(parameter) for parameter in method.gaussians.parameters()}
    grouped = [id(p) for group in method.parameter_groups() for p in group.parameters]
    assert sorted(grouped) == sorted({id(p) for p in method.parameters()} - rows)


def test_training_grows_within_the_budget(trained: Trainer, scene: Scene) -> None:
    start = create_method(trained.method.name, trained.method.config, scene, max_gaussians=1000)
    assert len(trained.method.gaussians) <= 1000
    # The strategy relocation may take away as many as it adds.
    relocates = trained.method.density == "relocation"
    assert len(start.gaussians) < len(trained.method.gaussians) + relocates


def test_it_comes_back_from_its_state_and_goes_on_in_the_same_bits(trained: Trainer, scene: Scene) -> None:
    method = trained.method
    copy = restore_method(method.name, method.config, method.state_dict())
    for name, value in method.state_dict().items():
        assert torch.equal(copy.state_dict()[name], value), name
    resumed = Trainer(copy, scene, TRAIN)
    resumed.restore(trained.state())
    assert resumed.step == TRAIN.steps
    state = trained.state()
    assert all(torch.equal(value, state[name]) for name, value in resumed.state().items())
    assert copy.fingerprint() == method.fingerprint()


def test_a_checkpoint_with_other_rows_is_refused(trained: Trainer) -> None:
    method = trained.method
    row = next(iter(method.row_rates()))
    state = dict(method.state_dict())
    state[f"gaussians.rows.{row}"] = state[f"gaussians.rows.{row}"][:-1]
    with pytest.raises(UserError, match="does not fit method"):
        restore_method(method.name, method.config, state)


@torch.no_grad()
def test_fuse_and_mix_agree(trained: Trainer, scene: Scene) -> None:
    method = trained.method
    first, second = (embeddings_of(method, scene, index) for index in (0, 1))
    whole = method.fuse(first)
    assert whole.shape == (method.num_gaussians, (method.sh_degree + 1) ** 2, 3)
    assert whole.isfinite().all()
    torch.testing.assert_close(method.fuse(method.mix([first, second], [1.0, 0.0])), whole)
    torch.testing.assert_close(
        method.fuse(method.mix([first, second], [0.5, 0.5])),
        method.fuse(method.mean(iter([first, second]), 2)),
        atol=1e-5,
        rtol=1e-4,
    )
    rows = torch.arange(0, method.num_gaussians, 3)
    appearance = encode_view(method, scene.views[0])
    torch.testing.assert_close(method.shade(appearance, rows), whole[rows], atol=1e-5, rtol=1e-4)


def test_photos_have_a_say_exactly_where_it_is_relightable(trained: Trainer, scene: Scene) -> None:
    method = trained.method
    with torch.no_grad():
        dark, bright = (method.fuse(embeddings_of(method, scene, index)) for index in (0, 1))
    assert torch.equal(dark, bright) != method.relightable
    assert (method.global_size > 0) == method.relightable


def test_lights_are_saved_and_averaged(trained: Trainer, scene: Scene, tmp_path: Path) -> None:
    method = trained.method
    look = look_of(method, encode_view(method, scene.views[0]), "0.jpg")
    file = tmp_path / "a.safetensors"
    if not method.relightable:
        with pytest.raises(UserError, match="cannot be relit"):
            save_look(look, file)
        assert mix([look, look], [0.5, 0.5]) is look
        return
    back = load_look(method, save_look(look, file))
    torch.testing.assert_close(back.sh, look.sh, atol=2e-2, rtol=2e-2)
    atlas = make_atlas(method, scene.train_views)
    assert atlas.global_embeddings.shape == (7, method.global_size)
    assert method.fuse(atlas.mean).isfinite().all()


def test_a_photo_lights_the_scene_more_like_itself_than_another_does(trained: Trainer, scene: Scene) -> None:
    """Held-out photos: nothing but their pixels tells a method which light they have."""
    method = trained.method
    if not method.relightable:
        pytest.skip("plain 3DGS has one light")
    dark, bright = (scene.views[index] for index in (0, 7))

    @torch.no_grad()
    def error(light, view) -> float:
        photo = light.read_photo().float() / 255
        sh = method.shade(method.encode(photo, light.camera))
        target = view.read_photo().float() / 255
        return float((method.render(view.camera, sh).colors - target).square().mean())

    assert error(dark, dark) < error(bright, dark)
    assert error(bright, bright) < error(dark, bright)


def test_declared_memory_holds_what_a_step_holds(trained: Trainer, scene: Scene) -> None:
    """Parameters, gradients, moments and what autograd keeps, per Gaussian; declared within a factor of eight."""
    method = trained.method
    view = scene.train_views[0]
    kept: dict[int, int] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        kept[tensor.data_ptr()] = tensor.numel() * tensor.element_size()
        return tensor

    photo = view.read_photo().float() / 255
    before = trained.method.training
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        output = method.train().training_pass(
            photo, view.camera, Stage(sh_degree=method.sh_degree), name=view.name
        )
    method.train(before)
    assert output.rendering.colors.isfinite().all()
    rows = sum(4 * values[0].numel() for values in method.gaussians.rows.values())
    # A parameter, its gradient, two moments, and one copy while densification replaces the rows.
    least = 5 * rows
    of_gaussians = sum(
        size
        for size in kept.values()
        if size >= 4 * len(method.gaussians) and size % len(method.gaussians) == 0
    )
    needed = least + of_gaussians / len(method.gaussians)
    assert least < method.memory.per_gaussian
    assert needed / 2 < method.memory.per_gaussian < 8 * needed


def test_presets_and_options_fit_every_method(trained: Trainer) -> None:
    config = RunConfig(Path("scene"), trained.method.name)
    assert with_preset(config, "paper").method == trained.method.name
    with pytest.raises(UserError, match=r"unknown; choose one of wildgs, "):
        method_type("nerf")


def test_the_example_in_the_docs_is_one_file_and_one_line(
    landmark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Train with its own option, evaluate, render, save a light, bench: by the command line."""
    from wildgs.cli import main

    (code,) = re.findall(
        r"^```python\n(.*?)^```$", DOCS.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    (tmp_path / "toy_of_the_docs.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(registry.METHODS, "toy", registry.Registered("toy_of_the_docs:Toy"))

    def wildgs(*arguments: object) -> None:
        main([str(argument) for argument in arguments])

    run = tmp_path / "run"
    wildgs("train", landmark, "--output", run, "--method", "toy", "--rate", 0.02, "--steps", 6)
    text = (run / "config.yaml").read_text()
    assert "method: toy" in text
    assert "rate: 0.02" in text
    wildgs("eval", run, "--protocol", "half")
    photo = next(path.name for path in sorted((landmark / "images").iterdir()))
    still = ("--path", "still", "--view", photo, "--size", 32, 24)
    wildgs("render", run, "--appearance", photo, *still, "--output", tmp_path / "out")
    wildgs("appearance", run, photo, "--output", tmp_path / "light.safetensors")
    assert (tmp_path / "light.safetensors").is_file()
    common = ("--steps", 4, "--seeds", 0, "--methods", "toy")
    wildgs("bench", landmark, "--output", tmp_path / "bench", *common)
    assert "| Toy |" in (tmp_path / "bench/table.md").read_text()
