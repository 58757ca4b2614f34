"""2D Parsing: shapes, pretrained weights from a folder, and a function that does not drift."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn import functional
from transformers import ResNetConfig, ResNetModel

from wildgs.engine.config import ScheduleConfig
from wildgs.engine.schedule import Schedule
from wildgs.errors import UserError, WildGSWarning
from wildgs.model.config import SQUEEZENET, ParsingConfig
from wildgs.model.encoder import RESNET_WIDTHS, FrozenBatchNorm, SqueezeNetEncoder, load_encoder
from wildgs.model.parsing import FeatureCache, Parsing, pack, unpack
from wildgs.model.precision import lay_out_channels_last, set_precision
from wildgs.model.replays import MOST_GRAPHS
from wildgs.model.wildgs import WildGS


@pytest.fixture(scope="module", params=[SQUEEZENET, None], ids=["squeezenet", "resnet"])
def parsing(request: pytest.FixtureRequest) -> Parsing:
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(request.param))
    parsing.calibrate([torch.rand(40, 60, 3) for _ in range(4)])
    return parsing


def save_resnet(folder: Path, widths: list[int]) -> ResNetModel:
    config = ResNetConfig(
        embedding_size=64, hidden_sizes=widths, depths=[2] * len(widths), layer_type="basic"
    )
    model = ResNetModel(config)
    model.save_pretrained(folder)
    return model


@pytest.mark.parametrize("size", [(48, 64), (100, 37), (7, 300), (1, 1)])
def test_mask_has_the_photos_size_and_starts_static(parsing: Parsing, size: tuple[int, int]) -> None:
    visibility, embedding = parsing(torch.rand(*size, 3))
    assert visibility.shape == size
    assert embedding.shape == (16,)
    assert (visibility > 0.5).all()
    assert (visibility < 1).all()


@pytest.mark.parametrize("size", [(64, 42), (42, 64), (300, 7), (20, 20)])
def test_narrow_photos_are_parsed_alike_in_bfloat16(parsing: Parsing, size: tuple[int, int]) -> None:
    """A convolution to a map of width one gave what was left in memory; see `LEAST_SIDE`."""
    photo = torch.rand(*size, 3)
    set_precision(parsing, torch.bfloat16)
    lay_out_channels_last(parsing)
    try:
        first = parsing(photo)
        for _ in range(20):
            left = [torch.full((count,), float("nan")) for count in (1_000, 5_000, 20_000, 100_000) * 3]
            del left
            for found, wanted in zip(parsing(photo), first, strict=True):
                torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    finally:
        set_precision(parsing, torch.float32)


def test_same_photo_gives_the_same_in_training_and_evaluation(parsing: Parsing) -> None:
    photo = torch.rand(48, 64, 3)
    trained = parsing.train()(photo)
    parsing(torch.rand(48, 64, 3))
    evaluated = parsing.eval()(photo)
    torch.testing.assert_close(trained, evaluated)


def test_brightness_reaches_the_global_embedding(parsing: Parsing) -> None:
    """What group or instance normalisation would remove."""
    photo = torch.rand(48, 64, 3)
    difference = (parsing(photo)[1] - parsing(photo * 0.3)[1]).norm()
    assert difference > 1e-3


def test_mask_and_embedding_train_a_resnet() -> None:
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(None))
    parsing.calibrate([torch.rand(40, 60, 3) for _ in range(4)])
    torch.nn.init.normal_(parsing.mask_head.weight, std=0.1)
    for output in (0, 1):
        parsing.zero_grad()
        parsing(torch.rand(48, 64, 3))[output].sum().backward()
        gradient = next(parsing.encoder.embedder.parameters()).grad
        assert gradient is not None
        assert gradient.abs().sum() > 0


def reference_squeezenet(images: torch.Tensor, weights: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    """SqueezeNet 1.1 as its paper draws it, by functional calls on named weights."""

    def convolve(x: torch.Tensor, name: str, **options: int) -> torch.Tensor:
        return functional.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], **options).clamp_min(
            0
        )

    x, taps = convolve(images, "0", stride=2), []
    for stage in ((3, 4), (6, 7), (9, 10, 11, 12)):
        x = functional.max_pool2d(x, 3, 2, ceil_mode=True)
        for fire in stage:
            x = convolve(x, f"{fire}.squeeze")
            x = torch.cat(
                [convolve(x, f"{fire}.expand1x1"), convolve(x, f"{fire}.expand3x3", padding=1)], dim=1
            )
            if fire in (4, 7, 9, 12):
                taps.append(x)
    return taps


@pytest.mark.shared
def test_frozen_features_are_those_of_the_published_weights(shared: Path) -> None:
    file = shared / "weights" / "lpips_squeeze" / "squeezenet1_1_features.pth"
    weights = torch.load(file, map_location="cpu", weights_only=True)
    images = torch.rand(2, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    expected = reference_squeezenet((images - mean[:, None, None]) / std[:, None, None], weights)
    encoder = load_encoder()
    assert isinstance(encoder, SqueezeNetEncoder)
    for ours, theirs in zip(encoder.raw(images), expected, strict=True):
        assert ours.dtype == torch.float16
        assert float((ours.float() - theirs).norm() / theirs.norm()) < 2e-3


def test_frozen_features_are_standardised_over_the_collection_and_the_statistics_saved() -> None:
    encoder = load_encoder()
    images = torch.rand(4, 3, 64, 64) * torch.rand(4, 3, 1, 1)
    encoder.calibrate(images)
    for features in encoder(images):
        torch.testing.assert_close(
            features.mean(dim=(0, 2, 3)), torch.zeros(features.shape[1]), atol=1e-2, rtol=0
        )
        assert float(features.std()) == pytest.approx(1, abs=0.02)
    state = encoder.state_dict()
    assert sum(value.numel() for value in state.values()) < 10_000, (
        "the package's weights are in no checkpoint"
    )
    other = load_encoder()
    other.load_state_dict(state)
    for ours, theirs in zip(encoder(images), other(images), strict=True):
        assert torch.equal(ours, theirs)
    assert list(encoder.parameters()) == []


def test_kept_features_have_no_influence_and_stay_within_the_limit() -> None:
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64))
    photos = {f"{index}.jpg": torch.rand(48, 64, 3) for index in range(3)}
    parsing.calibrate(list(photos.values()))
    torch.nn.init.normal_(parsing.mask_head.weight)
    expected = {name: parsing(photo) for name, photo in photos.items()}
    one = pack(parsing.encoder.raw(parsing.shrink(photos["0.jpg"])))[0].nbytes  # pyright: ignore
    cache = parsing.feature_cache = FeatureCache(int(2.5 * one))
    for _ in range(2):
        for name, photo in photos.items():
            for found, wanted in zip(parsing(photo, name=name), expected[name], strict=True):
                assert torch.equal(found, wanted)
    assert len(cache) == 2
    assert 0 < cache.num_bytes <= cache.limit
    parsing(torch.rand(48, 64, 3))
    assert len(cache) == 2, "photos without a name are not kept"


def test_features_are_computed_once_a_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    parsing = Parsing(ParsingConfig(max_side=64))
    parsing.feature_cache = FeatureCache(2**20)
    calls = []
    raw = parsing.encoder.raw
    monkeypatch.setattr(parsing.encoder, "raw", lambda images: calls.append(1) or raw(images))
    for _ in range(3):
        parsing(torch.rand(48, 64, 3), name="a.jpg")
    assert len(calls) == 1


def test_packed_tensors_come_back() -> None:
    tensors = [torch.rand(1, 3, 4, 5).half(), torch.rand(1, 6).half()]
    for found, wanted in zip(unpack(*pack(tensors)), tensors, strict=True):
        assert torch.equal(found, wanted)


def test_calibration_normalises_a_fresh_encoder() -> None:
    encoder = load_encoder(None)
    images = torch.rand(4, 3, 64, 64) * 0.1
    encoder.calibrate(images)
    features = encoder(images)
    assert [f.shape[1] for f in features] == list(RESNET_WIDTHS)
    assert 0.1 < float(features[-1].detach().std()) < 10


def test_calibration_tells_photos_apart() -> None:
    """Before training, embeddings spread over the photos: without it they differ in the third digit."""
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(None))
    photos = [torch.rand(64, 64, 3) * brightness for brightness in (0.2, 0.4, 0.6, 0.8, 1.0)]
    before = torch.stack([parsing(photo)[1] for photo in photos]).detach()
    parsing.calibrate(photos)
    after = torch.stack([parsing(photo)[1] for photo in photos]).detach()
    torch.testing.assert_close(after.mean(dim=0), torch.zeros(16), atol=0.05, rtol=0)
    torch.testing.assert_close(after.std(dim=0), torch.ones(16), atol=0.05, rtol=0)
    assert float(before.std(dim=0).max()) < 0.1


def test_colour_statistics_alone_tell_casts_and_brightness_apart() -> None:
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(None))
    photos = [torch.rand(64, 64, 3) * brightness for brightness in (0.2, 0.4, 0.6, 0.8, 1.0)]
    green = torch.tensor([0.95, 1.05, 0.95])
    parsing.calibrate([photos[0] * green, *photos[1:3], photos[3] * green, photos[4]])
    with torch.no_grad():
        parsing.global_mlp[0].weight[:, : RESNET_WIDTHS[-1]] = 0.0
        embedding = parsing(photos[2])[1]
        shuffled = photos[2].reshape(-1, 3)[torch.randperm(64 * 64)].reshape(64, 64, 3)
        torch.testing.assert_close(parsing(shuffled)[1], embedding, atol=1e-4, rtol=0)
        assert float((parsing(photos[2] * green)[1] - embedding).norm()) > 1
        assert float((parsing(photos[2] * 0.7)[1] - embedding).norm()) > 1


def test_without_colour_statistics_embeddings_are_of_features_alone() -> None:
    parsing = Parsing(ParsingConfig(max_side=64, color_statistics=False), load_encoder(None))
    assert parsing.global_mlp[0].in_features == RESNET_WIDTHS[-1]
    assert parsing(torch.rand(64, 64, 3))[1].shape == (16,)


def test_calibration_on_equal_photos_stays_finite() -> None:
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(None))
    photo = torch.full((64, 64, 3), 0.5)
    parsing.calibrate([photo] * 3)
    visibility, embedding = parsing(photo)
    assert torch.isfinite(visibility).all()
    assert float(embedding.detach().abs().max()) < 1000


def test_pretrained_weights_come_from_a_folder(tmp_path: Path) -> None:
    saved = save_resnet(tmp_path, [64, 128, 256, 512])
    for norm in saved.modules():
        if isinstance(norm, torch.nn.BatchNorm2d):
            norm.running_mean.uniform_(-1, 1)  # pyright: ignore[reportOptionalMemberAccess]
    saved.save_pretrained(tmp_path)
    encoder = load_encoder(str(tmp_path))
    assert encoder.pretrained
    image = torch.rand(1, 3, 64, 64)
    normalised = (image - encoder.mean) / encoder.std
    expected = saved.eval()(normalised).last_hidden_state
    torch.testing.assert_close(encoder.train()(image)[-1], expected, rtol=1e-4, atol=1e-4)


def test_pretrained_statistics_are_not_recalibrated(tmp_path: Path) -> None:
    save_resnet(tmp_path, [64, 128, 256, 512])
    encoder = load_encoder(str(tmp_path))
    norm = next(m for m in encoder.modules() if isinstance(m, FrozenBatchNorm))
    before = norm.running_mean.clone()
    encoder.calibrate(torch.rand(2, 3, 32, 32))
    assert torch.equal(norm.running_mean, before)


def test_missing_weights_are_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.warns(WildGSWarning, match="learnt from scratch") as caught:
        encoder = load_encoder("nobody/no-such-network")
    assert len(caught) == 1
    assert not encoder.pretrained


def test_folder_with_another_network_is_a_users_mistake(tmp_path: Path) -> None:
    save_resnet(tmp_path, [8, 16])
    with pytest.raises(UserError, match="another network"):
        load_encoder(str(tmp_path))
    with pytest.raises(UserError, match="does not contain a ResNet-18"):
        load_encoder(str(tmp_path.parent))


@pytest.mark.parametrize("start", [60.0, -60.0])
def test_a_mask_far_out_comes_back(start: float) -> None:
    """A sigmoid at the end of its range passes no gradient; masks that had closed stayed closed."""
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(max_side=64), load_encoder(None))
    assert parsing.mask_head.bias is not None
    torch.nn.init.constant_(parsing.mask_head.bias, start)
    optimizer = torch.optim.SGD([parsing.mask_head.bias], lr=2e5)
    photo = torch.rand(32, 48, 3)
    for _ in range(2):
        visibility, _ = parsing(photo)
        assert 0.002 < float(visibility.detach().min()) <= float(visibility.detach().max()) < 0.998
        optimizer.zero_grad()
        (visibility.mean() if start > 0 else -visibility.mean()).backward()
        optimizer.step()
    moved = float(parsing.mask_head.bias.detach() - start)
    assert moved < 0 if start > 0 else moved > 0
    before = parsing.mask_head.bias.detach().clone()
    torch.nn.init.constant_(parsing.mask_head.bias, start)
    optimizer.zero_grad()
    visibility, _ = parsing(photo)
    (-visibility.mean() if start > 0 else visibility.mean()).backward()
    optimizer.step()
    assert float(parsing.mask_head.bias.detach()) == start, "further out there is nothing to go to"
    assert float(before) != start


def test_all_shapes_and_stages_fit_into_the_graphs(parsing: Parsing, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos of up to three to one, on steps in which the encoder and the mask learn, and do not."""
    large = Parsing(ParsingConfig(max_side=256), parsing.encoder)
    keys = set()

    def remember(network, modules, image, settings):
        keys.add((tuple(image.shape), *settings))
        return torch.zeros(1, 1, 4, 4), torch.zeros(16)

    monkeypatch.setattr(large, "replays", remember)
    schedule = Schedule(ScheduleConfig(), 30_000, WildGS.reset_every)
    stages = [schedule.stage(step, 1) for step in range(4000, 4010)]
    settings = {(stage.learn_encoder, stage.learn_mask) for stage in stages}
    for short in range(164, 520, 20):
        for size in ((short, 512), (512, short)):
            for learn_encoder, learn_mask in settings:
                large(torch.zeros(*size, 3), learn_encoder=learn_encoder, learn_mask=learn_mask)
    assert len(keys) <= MOST_GRAPHS
