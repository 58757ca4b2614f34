import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.evaluation.lpips import ENVIRONMENT, LPIPS, MIN_SIDE, load_lpips

BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}


def save_random_weights(network, folder, backbone_name, linear_name, prefix="features."):
    """Files in torchvision's and LPIPS's layouts, with random numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    model = LPIPS(network)
    for parameter in model.features.parameters():
        parameter.normal_(0, 0.05)
    torch.save({prefix + k: v for k, v in model.features.state_dict().items()}, folder / backbone_name)
    linear = {f"lin{i}.model.1.weight": torch.rand(1, len(w), 1, 1) for i, w in enumerate(model.linear)}
    torch.save(linear, folder / linear_name)


def picture(seed: int, height: int = 64, width: int = 48) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=generator)


@pytest.mark.shared
@pytest.mark.parametrize("packaged", [True, False])
def test_known_distances(shared, monkeypatch, packaged):
    """The package's weights, in half precision, give what the published ones give."""
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    folder = shared / "weights" / "lpips_squeeze"
    model, note = load_lpips(None if packaged else folder)
    assert model is not None
    assert "SqueezeNet" in note
    names = ("ex_ref", "ex_p0", "ex_p1")
    reference, p0, p1 = (
        torch.from_numpy(np.array(Image.open(folder / "example" / f"{name}.png").convert("RGB")))
        for name in names
    )
    assert model(reference, p0).item() == pytest.approx(0.711, abs=1e-3)
    assert model(reference, p1).item() == pytest.approx(0.148, abs=1e-3)
    assert model(reference, reference).item() == 0


@pytest.mark.parametrize(("network", "parameters"), [("alex", 2_469_696), ("squeeze", 722_496)])
def test_backbones_have_torchvisions_size(network, parameters):
    assert sum(p.numel() for p in LPIPS(network).features.parameters()) == parameters


@pytest.mark.parametrize("network", ["alex", "squeeze"])
def test_distance_is_symmetric_and_zero_for_equal_pictures(network, tmp_path):
    save_random_weights(network, tmp_path, BACKBONES[network], f"{network}.pth")
    model, _ = load_lpips(tmp_path)
    assert model is not None
    first, second = picture(0), picture(1)
    assert model(first, first).item() == 0
    assert model(first, second).item() > 1e-4
    assert model(first, second).item() == pytest.approx(model(second, first).item(), rel=1e-5)


@pytest.mark.parametrize("network", ["alex", "squeeze"])
def test_smallest_picture_works_and_smaller_ones_are_refused(network):
    model = LPIPS(network)
    assert model(picture(0, MIN_SIDE, MIN_SIDE), picture(1, MIN_SIDE, MIN_SIDE)).isfinite()
    with pytest.raises(ValueError, match="pixels per side"):
        model(picture(0, MIN_SIDE - 1, 40), picture(1, MIN_SIDE - 1, 40))


def test_alexnet_comes_first(tmp_path):
    save_random_weights("squeeze", tmp_path, BACKBONES["squeeze"], "lpips_squeeze.pth")
    save_random_weights("alex", tmp_path, BACKBONES["alex"], "lpips_alex.pth")
    model, note = load_lpips(tmp_path)
    assert model is not None
    assert model.network == "alex"
    assert "AlexNet" in note


def test_setting_names_a_folder(tmp_path, monkeypatch):
    save_random_weights("squeeze", tmp_path / "mine", "squeezenet1_1_features.pth", "linear.pth", prefix="")
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "mine"))
    model, _ = load_lpips()
    assert model is not None
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "elsewhere"))
    model, note = load_lpips()
    assert model is None
    assert "elsewhere" in note
    monkeypatch.setenv(ENVIRONMENT, "off")
    assert load_lpips()[0] is None
    monkeypatch.delenv(ENVIRONMENT)
    model, note = load_lpips()
    assert model is not None
    assert "(squeeze)" in note


@pytest.mark.parametrize("content", [b"", b"no weights", b"\x80\x02cposix\nsystem\n."])
def test_broken_or_hostile_files_leave_lpips_out(tmp_path, content):
    (tmp_path / "squeezenet1_1_features.pth").write_bytes(content)
    (tmp_path / "linear.pth").write_bytes(content)
    model, note = load_lpips(tmp_path)
    assert model is None
    assert "squeezenet1_1_features.pth" in note


def test_weights_of_another_network_are_refused(tmp_path):
    save_random_weights("alex", tmp_path, "squeezenet1_1_features.pth", "linear.pth", prefix="")
    model, note = load_lpips(tmp_path)
    assert model is None
    assert "cannot load" in note
