"""What the page carries is the scene, up to known steps."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
import torch

from wildgs.exporters.page_scene import PackedScene, pack_scene
from wildgs.exporters.splats import Splats


def _planes(packed: PackedScene) -> dict[str, np.ndarray]:
    data = np.frombuffer(gzip.decompress(packed.data), np.uint8)
    planes, start = {}, 0
    for name, channels in packed.header["planes"]:
        end = start + channels * packed.header["count"]
        planes[name] = data[start:end].reshape(channels, -1)
        start = end
    assert start == len(data)
    return planes


def _means(packed: PackedScene) -> np.ndarray:
    planes, bounds = _planes(packed)["means"].astype(np.int64), packed.header["means"]
    steps = planes.reshape(3, 3, -1)
    codes = (steps[:, 0] << 16) + (steps[:, 1] << 8) + steps[:, 2]
    low, high = np.array(bounds["least"]), np.array(bounds["most"])
    return np.sinh(low + codes.T / (2**24 - 1) * (high - low))


def _lights(splats: Splats) -> list[np.ndarray]:
    generator = torch.Generator().manual_seed(1)
    other = splats.sh + 0.1 * torch.randn(splats.sh.shape, generator=generator)
    return [splats.sh.numpy(), other.numpy()]


def _order(packed: PackedScene, splats: Splats) -> np.ndarray:
    found = _means(packed)
    order = np.linalg.norm(found[:, None] - splats.means.numpy()[None], axis=2).argmin(axis=1)
    assert sorted(order) == list(range(len(splats)))
    return order


def test_places_are_kept_near_and_far(splats: Splats) -> None:
    means = splats.means.clone()
    means[0] = torch.tensor([900.0, -4000.0, 30.0])  # a piece of sky
    far = Splats(means, splats.quats, splats.scales, splats.opacities, splats.sh)
    packed = pack_scene(far, _lights(far))
    order = _order(packed, far)
    error = np.linalg.norm(_means(packed) - means.numpy()[order], axis=1)
    assert (error / (1 + means[order].norm(dim=1).numpy())).max() < 3e-6


def test_sizes_opacities_and_orientations_come_back(splats: Splats) -> None:
    packed = pack_scene(splats, _lights(splats))
    planes, order = _planes(packed), _order(packed, splats)
    scales = np.exp(packed.header["scales"]["least"] + packed.header["scales"]["step"] * planes["scales"].T)
    np.testing.assert_allclose(scales, splats.scales[order], rtol=0.02)
    np.testing.assert_allclose(planes["opacities"][0] / 255, splats.opacities[order], atol=0.5 / 255 + 1e-6)
    words = (planes["quats"].astype(np.uint32) << np.array([0, 8, 16, 24], np.uint32)[:, None]).sum(axis=0)
    small = np.stack([(words >> shift) & 1023 for shift in (0, 10, 20)]) / 1023 - 0.5
    small *= np.sqrt(2)
    for row, index in enumerate(order):
        large = np.sqrt(max(0.0, 1 - (small[:, row] ** 2).sum()))
        x, y, z, w = np.insert(small[:, row], words[row] >> 30, large)
        unit = splats.quats[index] / splats.quats[index].norm()
        assert abs(np.dot([w, x, y, z], unit.numpy())) > 1 - 1e-5


def test_every_light_comes_back_from_its_difference_to_the_first(splats: Splats) -> None:
    lights = _lights(splats)
    packed = pack_scene(splats, lights)
    planes, order, colors = _planes(packed), _order(packed, splats), packed.header["colors"]
    for index, light in enumerate(lights):
        codes = planes[f"light{index}"] if index == 0 else planes[f"light{index}"] + planes["light0"]
        for degree in range(4):
            band = slice(degree**2, (degree + 1) ** 2)
            expected = light[order][:, band]
            found = (
                colors["least"][degree]
                + colors["step"][degree] * codes.T.reshape(len(splats), 16, 3)[:, band]
            )
            error = np.abs(found - expected)
            assert np.quantile(error, 0.99) <= 0.51 * colors["step"][degree]
            assert error.mean() < 0.02


def test_a_further_light_costs_its_colours_alone(splats: Splats) -> None:
    lights = [light[:, :4] for light in _lights(splats)]
    one, two = (sum(row[1] for row in pack_scene(splats, lights[:n]).header["planes"]) for n in (1, 2))
    assert two - one == 12


def test_packing_gives_the_same_bytes_again(splats: Splats) -> None:
    assert pack_scene(splats, _lights(splats)) == pack_scene(splats, _lights(splats))


def test_nothing_to_show_is_refused(splats: Splats) -> None:
    with pytest.raises(ValueError, match="at least one light"):
        pack_scene(splats, [])
