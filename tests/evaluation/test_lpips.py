import threading
import time
import urllib.error

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.evaluation import lpips_weights
from wildgs.evaluation.lpips import LPIPS, MIN_SIDE
from wildgs.evaluation.lpips_weights import ENVIRONMENT, find_lpips, load_lpips


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


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """An empty hub cache, no setting, and a network that refuses; counts the attempts."""
    attempts = []

    def refuse(url, **_):
        attempts.append(url)
        raise urllib.error.URLError("no network")

    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    monkeypatch.setattr(lpips_weights, "_package_folders", list)
    lpips_weights._download.cache_clear()
    yield attempts
    lpips_weights._download.cache_clear()


@pytest.mark.shared
def test_known_distances(shared):
    folder = shared / "weights" / "lpips_squeeze"
    model, note = load_lpips(folder)
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
    save_random_weights(network, tmp_path, lpips_weights.OFFICIAL[network], f"{network}.pth")
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


def test_hub_cache_is_found_and_alexnet_comes_first(offline, tmp_path):
    checkpoints = tmp_path / "hub" / "checkpoints"
    save_random_weights("squeeze", checkpoints, "squeezenet1_1-b8a52dc0.pth", "lpips_squeeze.pth")
    found = find_lpips()
    assert found is not None
    assert found.network == "squeeze"
    save_random_weights("alex", checkpoints, "alexnet-owt-7be5be79.pth", "lpips_alex.pth")
    model, note = load_lpips()
    assert model is not None
    assert model.network == "alex"
    assert "AlexNet" in note
    assert offline == []


def test_setting_names_a_folder(offline, tmp_path, monkeypatch):
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
    assert offline == []


def test_without_weights_the_download_is_tried_once(offline):
    for _ in range(2):
        model, note = load_lpips()
        assert model is None
        assert "null" in note
        assert "curl" in note
    assert len(offline) == 1


def test_a_network_that_hangs_is_given_up(offline, monkeypatch):
    release = threading.Event()
    monkeypatch.setattr(lpips_weights, "_TIMEOUT_SECONDS", 0.1)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: release.wait(30))
    start = time.monotonic()
    assert load_lpips()[0] is None
    assert time.monotonic() - start < 5
    release.set()


def test_download_reads_weights_only_and_lands_in_the_cache(offline, tmp_path, monkeypatch):
    requests = []

    def serve(url, *, file_name, weights_only, check_hash, **_):
        requests.append((url.rsplit("/", 1)[1], weights_only, check_hash))
        checkpoints = tmp_path / "hub" / "checkpoints"
        save_random_weights("alex", tmp_path / "remote", "alexnet-owt-7be5be79.pth", "alex.pth")
        checkpoints.mkdir(parents=True, exist_ok=True)
        name = url.rsplit("/", 1)[1]
        (checkpoints / file_name).write_bytes((tmp_path / "remote" / name).read_bytes())

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", serve)
    model, _ = load_lpips()
    assert model is not None
    assert requests == [("alex.pth", True, False), ("alexnet-owt-7be5be79.pth", True, True)]


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
