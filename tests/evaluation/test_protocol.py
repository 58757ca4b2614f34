import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.memory_views import make_view
from wildgs.errors import UserError
from wildgs.evaluation.lpips import ENVIRONMENT
from wildgs.evaluation.protocol import evaluate
from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance
from wildgs.model.gaussians import GEOMETRY_ROWS, Gaussians, geometry_from_points
from wildgs.model.method import Method
from wildgs.model.training_pass import Stage, TrainingOutput
from wildgs.rasterize import Rendering
from wildgs.scene.scene import Alignment, Scene, View

H, W = 40, 61


class Painter(Method):
    """Renders the picture that `paint` makes of the photo it was shown, and keeps what it was shown."""

    def __init__(self, paint: Callable[[torch.Tensor], torch.Tensor], mask: bool = True) -> None:
        super().__init__()
        self.gaussians = Gaussians(geometry_from_points(torch.rand(7, 3)))
        self.painting = paint
        self.mask = mask
        self.responds = False
        self.shown: list[tuple[torch.Tensor, Camera]] = []
        self.keeps: list[torch.Tensor | None] = []

    @classmethod
    def rows(cls, config):
        return GEOMETRY_ROWS

    @classmethod
    def create(cls, config, initial):
        raise AssertionError("not from points")

    blank = create
    row_rates = embed = fuse = create

    def encode(self, photo, camera, keep=None, *, name=None, trust_mask=True, explicit=True):
        assert name is None, "the protocol decides what is shown of a photo"
        assert not self.training
        assert not torch.is_grad_enabled()
        self.shown.append((photo, camera))
        self.keeps.append(keep)
        response = photo.mean(dim=(0, 1)) if self.responds else None
        return Appearance(visibility=self.visibility(photo), response=response)

    def visibility(self, photo):
        assert not torch.is_grad_enabled()
        return photo[..., 0].clone() if self.mask else None

    def shade(self, appearance, rows=None):
        return torch.zeros(7, 1, 3)

    def training_pass(self, photo, camera, stage: Stage, keep=None, *, name=None) -> TrainingOutput:
        raise AssertionError("evaluation must not train")

    def render(self, camera, sh, *, background=None, response=None):
        colors = self.painting(self.shown[-1][0])
        if response is not None:
            colors = colors * response
        assert colors.shape == (camera.height, camera.width, 3)
        return Rendering(colors, torch.ones(H, W), torch.ones(H, W))


def camera() -> Camera:
    return Camera(torch.eye(4), torch.tensor([[50.0, 0, W / 2], [0, 50.0, H / 2], [0, 0, 1]]), W, H)


def picture(seed: int) -> torch.Tensor:
    return torch.randint(0, 256, (H, W, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def view(name, split="test", photo=None, mask=None, clean=None, truth_mask=None) -> View:
    photo = picture(0) if photo is None else photo
    return make_view(name, camera(), split, photo, mask=mask, clean=clean, truth_mask=truth_mask)


def scene(*views: View) -> Scene:
    return Scene(
        Path("somewhere"),
        views,
        torch.zeros(1, 3),
        torch.zeros(1, 3, dtype=torch.uint8),
        Alignment.identity(),
    )


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch):
    monkeypatch.setenv(ENVIRONMENT, "off")


def read(file: Path) -> torch.Tensor:
    return torch.from_numpy(np.array(Image.open(file)))


def test_full_shows_the_whole_photo_and_scores_the_whole_frame(tmp_path):
    method = Painter(lambda photo: photo + 10 / 255 * (photo < 0.9))
    photo = picture(0).clamp(max=200)
    content = evaluate(
        method, scene(view("a.jpg", photo=photo)), "full", tmp_path, step=30, train_seconds=1.5
    )
    assert torch.equal(method.shown[0][0], photo.float() / 255)
    assert method.shown[0][1].width == W
    assert content["images"][0]["psnr"] == pytest.approx(20 * math.log10(25.5))
    assert torch.equal(read(tmp_path / "eval/full/a.png"), photo + 10)
    assert json.loads((tmp_path / "eval/full/metrics.json").read_text()) == content
    assert not list(tmp_path.rglob("*.part"))


def test_half_sees_the_left_half_alone_and_scores_the_rest(tmp_path):
    photo = picture(1)

    def left_is_wrong(shown: torch.Tensor) -> torch.Tensor:
        whole = photo.float() / 255
        whole[:, : W // 2] = 0
        return whole

    method = Painter(left_is_wrong)
    content = evaluate(method, scene(view("a.jpg", photo=photo)), "half", tmp_path, step=1)
    for shown, cropped in method.shown:
        assert torch.equal(shown, photo[:, : W // 2].float() / 255)
        assert (cropped.width, cropped.height) == (W // 2, H)
        assert torch.equal(cropped.K, camera().K)
    assert content["images"][0]["psnr"] == 100
    assert content["images"][0]["ssim"] == pytest.approx(1)
    written = read(tmp_path / "eval/half/a.png")
    assert written.shape == (H, W, 3)
    assert (written[:, : W // 2] == 0).all()


def test_half_does_not_depend_on_the_right_half(tmp_path):
    other = picture(2)
    other[:, : W // 2] = picture(1)[:, : W // 2]
    renders = []
    for i, photo in enumerate((picture(1), other)):
        method = Painter(lambda shown: shown.mean() * torch.ones(H, W, 3))
        evaluate(method, scene(view("a.jpg", photo=photo)), "half", tmp_path / str(i), step=1)
        renders.append(read(tmp_path / str(i) / "eval/half/a.png"))
    assert torch.equal(renders[0], renders[1])


@pytest.mark.parametrize("protocol", ["full", "half"])
def test_the_cameras_response_of_what_is_seen_is_part_of_the_render(tmp_path, protocol):
    photo = torch.full((H, W, 3), 51, dtype=torch.uint8)
    photo[:, W // 2 :] = 255
    method = Painter(lambda seen: torch.ones(H, W, 3))
    method.responds = True
    evaluate(method, scene(view("a.png", photo=photo)), protocol, tmp_path, step=1)
    render = np.asarray(Image.open(tmp_path / "eval" / protocol / "a.png"))
    assert (render == 51).all() if protocol == "half" else (render > 100).all()


def test_metrics_file_holds_what_the_design_names(tmp_path):
    content = evaluate(
        Painter(lambda photo: photo), scene(view("a.jpg"), view("b.jpg")), "full", tmp_path, step=7
    )
    assert list(content) == [
        "protocol",
        "step",
        "num_gaussians",
        "train_seconds",
        "render_fps",
        "device",
        "lpips_network",
        "mean",
        "images",
        "notes",
        "static_hidden",
        "static_hidden_worst",
        "misfits",
    ]
    assert list(content["mean"]) == [
        "psnr",
        "ssim",
        "lpips",
        "landmark",
        "elsewhere",
        "detail_energy",
        "detail_correlation",
    ]
    assert content["mean"]["landmark"] is None  # this scene has no tracks
    assert content["static_hidden"] is None
    assert content["protocol"] == "full"
    assert content["num_gaussians"] == 7
    assert content["step"] == 7
    assert content["render_fps"] > 0
    assert [image["name"] for image in content["images"]] == ["a.jpg", "b.jpg"]
    assert content["lpips_network"] is None
    assert content["mean"]["lpips"] is None
    assert all(image["lpips"] is None for image in content["images"])
    assert any("LPIPS is null" in note for note in content["notes"])


def test_means_are_over_images(tmp_path):
    dark, bright = torch.zeros(H, W, 3, dtype=torch.uint8), torch.full((H, W, 3), 51, dtype=torch.uint8)
    method = Painter(lambda photo: torch.full((H, W, 3), 0.1))
    content = evaluate(
        method, scene(view("a.jpg", photo=dark), view("b.jpg", photo=bright)), "full", tmp_path, step=1
    )
    scores = [image["psnr"] for image in content["images"]]
    # Rounding to 8 bits: 0.1 is 25.5, which becomes 26 (to even).
    assert scores == pytest.approx([20 * math.log10(255 / 26), 20 * math.log10(255 / 25)])
    assert content["mean"]["psnr"] == pytest.approx(sum(scores) / 2)


def test_clean_truth_is_scored_instead_of_the_photo(tmp_path):
    clean = picture(5)
    method = Painter(lambda photo: clean.float() / 255)
    mask = torch.zeros(H, W, dtype=torch.uint8)
    content = evaluate(method, scene(view("a.jpg", clean=clean, mask=mask)), "full", tmp_path, step=1)
    assert content["mean"]["psnr"] == 100
    assert torch.equal(method.shown[0][0], picture(0).float() / 255)


def test_ignored_pixels_do_not_count(tmp_path):
    mask = torch.full((H, W), 255, dtype=torch.uint8)
    mask[:10] = 0

    def spoilt_where_ignored(photo: torch.Tensor) -> torch.Tensor:
        render = photo.clone()
        render[:10] = 1 - render[:10]
        return render

    content = evaluate(
        Painter(spoilt_where_ignored), scene(view("a.jpg", mask=mask)), "full", tmp_path, step=1
    )
    assert content["mean"]["psnr"] == 100
    assert any("mask ignores" in note for note in content["notes"])


def test_encoding_gets_the_mask_of_what_it_sees(tmp_path):
    mask = torch.full((H, W), 255, dtype=torch.uint8)
    mask[:10, :5] = 0
    whole, half = Painter(lambda p: p), Painter(lambda p: p[:, :1].expand(H, W, 3))
    evaluate(whole, scene(view("a.jpg", mask=mask)), "full", tmp_path, step=1)
    evaluate(half, scene(view("a.jpg", mask=mask)), "half", tmp_path, step=1)
    assert whole.keeps[0] is not None
    assert torch.equal(whole.keeps[0], mask > 0)
    assert half.keeps[0] is not None
    assert torch.equal(half.keeps[0], mask[:, : W // 2] > 0)


def test_a_view_with_nothing_to_score_is_null_and_left_out_of_the_mean(tmp_path):
    mask = torch.full((H, W), 255, dtype=torch.uint8)
    mask[:, W // 2 :] = 0
    photo = picture(3)
    views = (view("a.jpg", mask=mask), view("b.jpg", photo=photo))
    method = Painter(lambda shown: photo.float() / 255)
    content = evaluate(method, scene(*views), "half", tmp_path, step=1)
    assert content["images"][0].pop("name") == "a.jpg"
    assert set(content["images"][0].values()) == {None}
    assert content["mean"]["psnr"] == 100
    assert any("a.jpg" in note for note in content["notes"])


def test_names_keep_their_folders_and_never_leave_the_run(tmp_path):
    names = ["left/a.jpg", "right/a.jpg", "../../out.jpg", "/root.jpg", "b.jpg", "b.png", "B.PNG"]
    run = tmp_path / "deep" / "run"
    evaluate(Painter(lambda photo: photo), scene(*(view(name) for name in names)), "full", run, step=1)
    folder = run / "eval" / "full"
    written = {str(file.relative_to(folder)) for file in folder.rglob("*.png")}
    assert {"left/a.png", "right/a.png"} <= written
    assert len(written) == len(names)
    assert set(tmp_path.rglob("*.png")) == set(folder.rglob("*.png"))


def test_masks_are_scored_on_training_photos(tmp_path):
    truth = torch.full((H, W), 255, dtype=torch.uint8)
    truth[5:20, 10:30] = 0
    photo = truth[..., None].expand(H, W, 3).contiguous()
    views = (view("a.jpg", "train", photo, truth_mask=truth), view("b.jpg", "train"), view("c.jpg"))
    content = evaluate(Painter(lambda p: p), scene(*views), "full", tmp_path, step=1)
    assert content["masks"] == {"average_precision": 1.0, "iou": 1.0, "images": 1}
    for method, protocol in (
        (Painter(lambda p: p, mask=False), "full"),
        (Painter(lambda p: p[:, :1].expand(H, W, 3)), "half"),
    ):
        assert "masks" not in evaluate(method, scene(*views), protocol, tmp_path, step=1)


def test_renders_that_are_no_numbers_are_said_so(tmp_path):
    content = evaluate(
        Painter(lambda p: torch.full((H, W, 3), torch.nan)), scene(view("a.jpg")), "full", tmp_path, step=1
    )
    assert math.isfinite(content["mean"]["psnr"])
    assert any("non-finite" in note for note in content["notes"])


def test_training_mode_is_restored(tmp_path):
    method = Painter(lambda photo: photo).train()
    evaluate(method, scene(view("a.jpg")), "full", tmp_path, step=1)
    assert method.training


def test_a_scene_without_test_photos_is_a_users_mistake(tmp_path):
    with pytest.raises(UserError, match="no held-out photos"):
        evaluate(Painter(lambda photo: photo), scene(view("a.jpg", "train")), "full", tmp_path, step=1)


@pytest.mark.shared
def test_perceptual_distance_is_in_the_file_where_weights_are(tmp_path, shared):
    folder = shared / "weights" / "lpips_squeeze"
    mask = torch.full((H, W), 255, dtype=torch.uint8)
    mask[:20] = 0

    def spoilt_above(photo: torch.Tensor) -> torch.Tensor:
        render = photo.clone()
        render[:20] = 1 - render[:20]
        return render

    views = (view("a.jpg", mask=mask), view("b.jpg"))
    content = evaluate(Painter(spoilt_above), scene(*views), "full", tmp_path, step=1, lpips_folder=folder)
    scores = [image["lpips"] for image in content["images"]]
    assert scores[0] == 0
    assert scores[1] > 0.03
    assert content["mean"]["lpips"] == pytest.approx(scores[1] / 2)
    assert any("SqueezeNet" in note for note in content["notes"])
    small = evaluate(
        Painter(lambda p: p[:, :1].expand(H, W, 3)),
        scene(*views),
        "half",
        tmp_path,
        step=1,
        lpips_folder=folder,
    )
    assert small["mean"]["lpips"] is None
    assert any("pixels per side" in note for note in small["notes"])
