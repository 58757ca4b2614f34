"""The fusion network: where it starts, and the photo's colour transform."""

from __future__ import annotations

import pytest
import torch

from wildgs.geometry.spherical_harmonics import sh_basis
from wildgs.model.fusion import Fusion, FusionConfig


def eval_sh(sh: torch.Tensor, directions: torch.Tensor, degree: int) -> torch.Tensor:
    return (sh_basis(degree, directions)[:, :, None] * sh).sum(dim=1) + 0.5


def inputs(fusion: Fusion, colors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    intrinsic = fusion.initial_intrinsic(colors)
    return torch.randn(16), torch.randn(len(colors), 16), intrinsic


def test_starts_near_the_points_colours() -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(sh_degree=3), 16, 16)
    colors = torch.rand(50, 3)
    sh = fusion(*inputs(fusion, colors)).detach()
    seen = eval_sh(sh, torch.nn.functional.normalize(torch.randn(50, 3), dim=1), 3)
    assert float((seen - colors).abs().max()) < 0.3


@pytest.mark.parametrize("degree", [0, 3])
def test_the_transform_maps_colours_from_every_direction(degree: int) -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(sh_degree=degree), 16, 16)
    given = inputs(fusion, torch.rand(50, 3))
    directions = torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    before = eval_sh(fusion(*given), directions, degree)
    matrix, offset = torch.eye(3) + 0.3 * torch.randn(3, 3), 0.1 * torch.randn(3)
    assert fusion.transform is not None
    with torch.no_grad():
        fusion.transform.bias.copy_(torch.cat([(matrix - torch.eye(3)).flatten(), offset]))
    torch.testing.assert_close(
        eval_sh(fusion(*given), directions, degree), before @ matrix.T + offset, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("with_transform", [True, False])
def test_a_colour_map_acts_after_everything_else(with_transform: bool) -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(sh_degree=3, color_transform=with_transform), 16, 16)
    if fusion.transform is not None:
        torch.nn.init.normal_(fusion.transform.weight, std=0.1)
    given = inputs(fusion, torch.rand(50, 3))
    directions = torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    before = eval_sh(fusion(*given), directions, 3)
    change = 0.3 * torch.randn(3, 4)
    after = eval_sh(fusion(*given, change), directions, 3)
    torch.testing.assert_close(after, before + before @ change[:, :3].T + change[:, 3], atol=1e-4, rtol=0)


def test_the_embedding_drives_the_transform() -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(output_scale=0.0), 16, 16)
    embedding, local, intrinsic = inputs(fusion, torch.rand(8, 3))
    assert fusion.transform is not None
    torch.nn.init.normal_(fusion.transform.weight, std=0.1)
    changed = fusion(embedding, local, intrinsic) - fusion(0 * embedding, local, intrinsic)
    assert float(changed.detach()[:, 0].abs().min()) > 0
    assert Fusion(FusionConfig(color_transform=False), 16, 16).transform is None


def test_an_embedding_that_all_share_counts_as_one_for_each() -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(), 16, 16)
    common, _, intrinsic = inputs(fusion, torch.rand(40, 3))
    results = []
    for repeated in (False, True):
        shared = torch.linspace(-1, 1, 16).requires_grad_()
        local = shared.repeat(40, 1) if repeated else shared.expand(40, -1)
        sh = fusion(common, local, intrinsic)
        fusion.zero_grad()
        sh.square().sum().backward()
        results.append((sh.detach(), shared.grad, fusion.first_rows.weight.grad.clone()))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("apart", [True, False])
def test_regions_in_order_have_the_harmonics_of_gaussians_in_any_order(apart: bool) -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(), 16, 16)
    if apart:
        fusion.separate_sky()
    common, local = torch.randn(16), torch.randn(16).expand(40, -1)
    intrinsic, which = fusion.initial_intrinsic(torch.rand(40, 3)), torch.rand(40) < 0.3
    unordered = fusion.with_sky(common, local, intrinsic, which)
    ordered = fusion.by_region(common, local, intrinsic[~which], intrinsic[which])
    torch.testing.assert_close(ordered, torch.cat([unordered[~which], unordered[which]]))


@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("codes", [0, 3])
def test_some_of_all_rows_have_the_values_and_gradients_of_regions(
    apart: bool, shared: bool, codes: int
) -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(), 16, 16)
    if apart:
        fusion.separate_sky()
    common, local = torch.randn(16), torch.randn(16).expand(30, -1)
    local = local if shared else torch.randn(30, 16)
    rows, landmark = torch.randperm(40)[:30], 22
    features, weight = fusion.initial_intrinsic(torch.rand(40, 3)), torch.randn(codes, 32)
    results = []
    for taken in (False, True):
        intrinsic, matrix = features.clone().requires_grad_(), weight.clone().requires_grad_()
        fusion.zero_grad()
        if taken:
            sh, found = fusion.of_rows(common, local, intrinsic, rows, landmark, matrix if codes else None)
        else:
            below, above = intrinsic[rows[:landmark]], intrinsic[rows[landmark:]]
            sh, found = fusion.by_region(common, local, below, above), below @ matrix.T
        (sh.square().sum() + found.square().sum()).backward()
        parameters = [p.grad.clone() for p in fusion.parameters() if p.grad is not None]
        found_gradient = matrix.grad if codes else matrix.detach()
        results.append([sh.detach(), found.detach(), intrinsic.grad, found_gradient, *parameters])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


def test_the_networks_of_landmark_and_sky_share_no_weights() -> None:
    torch.manual_seed(0)
    fusion = Fusion(FusionConfig(), 16, 16)
    fusion.separate_sky()
    common, local = torch.randn(16), torch.randn(16).expand(40, -1)
    intrinsic, which = fusion.initial_intrinsic(torch.rand(40, 3)), torch.arange(40) >= 30
    fusion.with_sky(common, local, intrinsic, which)[which].sum().backward()
    assert fusion.sky is not None
    assert fusion.sky.second.weight.grad is not None
    assert float(fusion.second.weight.grad.abs().sum()) == 0
    before = fusion.with_sky(common, local, intrinsic, which).detach()
    with torch.no_grad():
        fusion.second.weight.mul_(2)
    after = fusion.with_sky(common, local, intrinsic, which).detach()
    assert torch.equal(before[which], after[which])
    assert not torch.equal(before[~which], after[~which])
