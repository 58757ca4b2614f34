import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.hub import hub_reachable
from wildgs.priors import depth as depth_prior
from wildgs.priors.depth import DepthEstimator, fill_depth_folder, load_depth_anything
from wildgs.scene import load_scene

MakeScene = Callable[..., Path]


@pytest.fixture(scope="module")
def tiny_network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Depth Anything in the hub's layout, with random weights and few of them."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    torch.manual_seed(0)
    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
    )
    folder = tmp_path_factory.mktemp("depth-anything")
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    return folder


class Recorder(torch.nn.Module):
    """Stands in for the network: keeps its input, and calls the picture's red channel disparity."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[torch.Tensor] = []

    def forward(self, pixel_values: torch.Tensor) -> object:
        self.seen.append(pixel_values)
        red = pixel_values[:, 0] * 0.229 + 0.485
        return type("Output", (), {"predicted_depth": red})()


def test_a_real_network_loads_and_gives_disparity_of_the_photos_size(tiny_network: Path) -> None:
    estimator = load_depth_anything(str(tiny_network), device="cpu")
    assert estimator is not None
    assert estimator.patch_size == 14
    photo = torch.randint(0, 255, (30, 47, 3), dtype=torch.uint8)
    disparity = estimator.estimate(photo)
    assert disparity.shape == (30, 47)
    assert (disparity >= 0).all()
    assert torch.equal(disparity, estimator.estimate(photo))


def test_the_network_sees_what_its_own_preparation_gives() -> None:
    estimator = DepthEstimator(Recorder())
    assert estimator.network_size(518, 518) == (518, 518)
    assert estimator.network_size(480, 640) == (518, 686)  # the published example of a 4:3 photo
    assert estimator.network_size(3000, 4000) == (518, 686)
    assert estimator.network_size(4000, 3000) == (686, 518)
    assert estimator.network_size(10, 4000)[0] == 14


def test_values_are_normalised_and_come_back_in_place() -> None:
    network = Recorder()
    photo = torch.zeros(259, 518, 3, dtype=torch.uint8)
    photo[:, 260:, 0] = 255
    disparity = DepthEstimator(network).estimate(photo)
    seen = network.seen[0]
    assert seen.shape[0:2] == (1, 3)
    assert seen.shape[2] % 14 == seen.shape[3] % 14 == 0
    blue = torch.full_like(seen[0, 2], (0 - 0.406) / 0.225)
    torch.testing.assert_close(seen[0, 2], blue)
    assert disparity[:, :250].max() < 0.02
    assert disparity[:, 270:].min() > 0.98


def test_the_folder_is_filled_and_read_back(make_scene: MakeScene) -> None:
    root = make_scene(names=["a/x.png", "b.png"])
    (root / "depth").mkdir()
    own = Image.fromarray(np.full((32, 48), 7, dtype=np.uint16))
    own.save(root / "depth/b.png")
    seen: list[tuple[int, int]] = []
    done = fill_depth_folder(root, DepthEstimator(Recorder()), progress=lambda *step: seen.append(step))
    assert done == (1, 1)
    assert seen == [(1, 2), (2, 2)]
    assert (np.asarray(Image.open(root / "depth/b.png")) == 7).all()  # what is there stays
    assert sorted(p.name for p in (root / "depth").rglob("*")) == ["a", "b.png", "x.png"]

    disparity = load_scene(root).views[0].read_disparity()
    assert disparity is not None
    assert disparity.max() == 1
    row = disparity[16]
    assert (row[4:-4].diff() > 0).all()  # the photo's red grows to the right
    assert fill_depth_folder(root, DepthEstimator(Recorder()), overwrite=True) == (2, 0)
    assert (np.asarray(Image.open(root / "depth/b.png")) != 7).any()


def test_large_photos_are_stored_at_the_networks_detail(make_scene: MakeScene) -> None:
    root = make_scene(1)
    Image.new("RGB", (2400, 1600), (200, 0, 0)).save(root / "images/p00.png")
    fill_depth_folder(root, DepthEstimator(Recorder()))
    stored = Image.open(root / "depth/p00.png")
    assert stored.size == (1036, 691)
    assert np.asarray(stored).dtype == np.uint16
    disparity = load_scene(root).views[0].read_disparity()
    assert disparity is not None
    assert (disparity > 0.9).all()


def test_an_unreadable_photo_gets_no_depth(make_scene: MakeScene) -> None:
    root = make_scene(2)
    (root / "images/p00.png").write_bytes(b"")
    with pytest.warns(WildGSWarning, match=r"p00\.png.*no depth"):
        assert fill_depth_folder(root, DepthEstimator(Recorder())) == (1, 0)


def test_folders_that_hold_something_else_are_errors(tmp_path: Path, tiny_network: Path) -> None:
    with pytest.raises(UserError, match="no Depth Anything in the hub's layout"):
        load_depth_anything(str(tmp_path))
    with pytest.raises(UserError, match="no such folder"):
        load_depth_anything(str(tmp_path / "nowhere"))
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "config.json").write_bytes((tiny_network / "config.json").read_bytes())
    (broken / "model.safetensors").write_bytes(b"\0" * 100)
    with pytest.raises(UserError, match="no Depth Anything in the hub's layout"):
        load_depth_anything(str(broken))


def test_where_it_cannot_be_had_one_warning_says_so_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_prior, "hub_reachable", lambda: False)
    started = time.monotonic()
    with pytest.warns(
        WildGSWarning, match="only depth maps already in depth/ are used.*hf download"
    ) as caught:
        assert load_depth_anything("wildgs-tests/not-there") is None
    assert len(caught) == 1
    assert time.monotonic() - started < 60
    with pytest.raises(UserError, match="hf download"):
        load_depth_anything("wildgs-tests/not-there", required=True)


def test_the_hub_is_asked_once_and_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # takes the call and never answers
        monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        started = time.monotonic()
        assert not hub_reachable(timeout=0.3)
        assert time.monotonic() - started < 5
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert not hub_reachable()
