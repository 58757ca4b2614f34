import itertools
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from tests.scene_files import photo
from wildgs.errors import UserError, WildGSWarning
from wildgs.scene import DataConfig, Scene, load_scene
from wildgs.scene.undistort import PixelGrid

MakeScene = Callable[..., Path]
W, H = 48, 32
SPLIT = "filename\tid\tsplit\tdataset\n"


def project(points: torch.Tensor, view) -> torch.Tensor:
    local = points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    return (local @ view.camera.K.T)[:, :2] / local[:, 2:]


@pytest.mark.parametrize(
    ("layout", "images"),
    [
        ("sparse/0", "images"),
        ("sparse", "images"),
        ("dense/sparse", "dense/images"),
        ("dense/sparse/0", "dense/images"),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_every_layout_gives_the_same_scene(
    make_scene: MakeScene, layout: str, images: str, binary: bool
) -> None:
    root = make_scene(9, layout=layout, images=images, binary=binary)
    scene = load_scene(root)
    assert [v.name for v in scene.views] == [f"p{i:02d}.png" for i in range(9)]
    assert [v.name for v in scene.test_views] == ["p00.png", "p08.png"]
    assert scene.points.shape == (60, 3)
    assert scene.points.dtype == torch.float32
    view = scene.views[0]
    assert (view.camera.width, view.camera.height) == (W, H)
    assert view.camera.viewmat.dtype == view.camera.K.dtype == torch.float32
    assert view.read_photo().shape == (H, W, 3)
    assert view.read_photo().dtype == torch.uint8
    assert view.read_mask() is None
    assert view.read_disparity() is None
    assert view.read_clean() is None
    assert view.read_truth_mask() is None


def test_text_models_may_begin_with_a_byte_order_mark(make_scene: MakeScene) -> None:
    root = make_scene(3, binary=False)
    for file in (root / "sparse/0").glob("*.txt"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    assert len(load_scene(root).views) == 3


def test_points_project_where_colmap_projects_them(make_scene: MakeScene) -> None:
    root = make_scene(5)
    scene = load_scene(root, DataConfig(downscale=2))
    model = pycolmap.Reconstruction(root / "sparse/0")
    inputs = [point.xyz for _, point in sorted(model.points3D.items())]
    for view in scene.views:
        image = model.find_image_with_name(view.name)
        expected = np.array([image.project_point(point) for point in inputs]) / 2
        np.testing.assert_allclose(project(scene.points, view).numpy(), expected, atol=2e-3)


def test_downscale_divides_size_and_intrinsics(make_scene: MakeScene) -> None:
    root = make_scene(3)
    full, half = load_scene(root), load_scene(root, DataConfig(downscale=2))
    third = load_scene(root, DataConfig(downscale=3.0))
    assert half.views[1].read_photo().shape == (16, 24, 3)
    torch.testing.assert_close(half.views[1].camera.K[:2], full.views[1].camera.K[:2] / 2)
    assert third.views[1].read_photo().shape == (11, 16, 3)
    assert third.views[1].camera.K[1, 1].item() == pytest.approx(41 * 11 / 32)
    assert torch.equal(half.views[1].camera.viewmat, full.views[1].camera.viewmat)


def test_a_limit_per_photo_reduces_large_photos_alone(tmp_path: Path) -> None:
    """Sizes as a web collection has them: one divisor for all would leave 30 pixels of the small ones."""
    sizes = [(4000, 2000), (900, 1200), (300, 200), (640, 480)]
    for (width, height), most in itertools.product(sizes, (1, 37, 400, 641)):
        params = [0.9 * width, 0.9 * width, 0.45 * width, 0.55 * height]
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        grid = PixelGrid.from_colmap(camera, max_side=most)
        assert max(grid.width, grid.height) == min(most, max(width, height))
        assert (
            abs(grid.width / grid.height - width / height) * min(grid.width, grid.height) < 1 + width / height
        )
        scale = grid.width / width, grid.height / height
        expected = [0.9 * width * scale[0], 0.9 * width * scale[1], 0.45 * grid.width, 0.55 * grid.height]
        np.testing.assert_allclose([grid.K[0, 0], grid.K[1, 1], grid.K[0, 2], grid.K[1, 2]], expected)
    divided = PixelGrid.from_colmap(camera, downscale=4, max_side=400)
    assert (divided.width, divided.height) == (160, 120)
    assert PixelGrid.from_colmap(camera, downscale=1.1, max_side=400).width == 400


@pytest.mark.parametrize("distortion", [-0.3, -0.1, 0.1, 0.3])
@pytest.mark.parametrize("most", [50, 333])
def test_the_limit_holds_for_undistorted_views(distortion: float, most: int) -> None:
    params = [700.0, 500.0, 300.0, distortion]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=600, params=params)
    grid = PixelGrid.from_colmap(camera, max_side=most)
    assert max(0.7 * most, 1) < max(grid.width, grid.height) <= most


def test_scenes_with_photos_of_two_sizes(make_scene: MakeScene) -> None:
    root = make_scene(3)
    model = pycolmap.Reconstruction(root / "sparse/0")
    model.cameras[2].rescale(4 * W, 4 * H)
    model.write_binary(root / "sparse/0")
    path = root / "images/p01.png"
    Image.open(path).resize((4 * W, 4 * H)).save(path)
    views = load_scene(root, DataConfig(max_side=2 * W)).views
    assert [view.read_photo().shape[:2] for view in views] == [(H, W), (2 * H, 2 * W), (H, W)]
    full = load_scene(root).views
    torch.testing.assert_close(views[1].camera.K[:2], full[1].camera.K[:2] / 2)
    assert torch.equal(views[0].camera.K, full[0].camera.K)


def test_photos_smaller_than_their_camera_carry_its_intrinsics(make_scene: MakeScene) -> None:
    root = make_scene(3)
    path = root / "images/p01.png"
    Image.open(path).resize((W // 2, H // 2)).save(path)
    scene = load_scene(root, DataConfig(downscale=2))
    assert scene.views[1].read_photo().shape == (H // 2, W // 2, 3)
    assert torch.equal(scene.views[1].camera.K, scene.views[0].camera.K)


def test_a_photo_of_another_shape_is_an_error(make_scene: MakeScene) -> None:
    root = make_scene(3)
    Image.new("RGB", (W, W)).save(root / "images/p01.png")
    with pytest.raises(UserError, match=r"p01\.png: 48x48 pixels, but its camera is 48x32"):
        load_scene(root)


def test_simple_pinhole_is_used_as_it_is(make_scene: MakeScene) -> None:
    camera = {"model": "SIMPLE_PINHOLE", "width": W, "height": H, "params": [44, 23, 17]}
    view = load_scene(make_scene(2, camera=camera)).views[0]
    expected = torch.tensor([[44.0, 0, 23], [0, 44, 17], [0, 0, 1]])
    torch.testing.assert_close(view.camera.K, expected)


def distorted(k1: float) -> dict:
    return {"model": "SIMPLE_RADIAL", "width": W, "height": H, "params": [40, 24, 16, k1]}


def test_distortion_of_zero_changes_nothing(make_scene: MakeScene) -> None:
    root = make_scene(2, camera=distorted(0.0))
    stored = np.asarray(Image.open(root / "images/p00.png"))
    assert np.array_equal(load_scene(root).views[0].read_photo().numpy(), stored)


@pytest.mark.parametrize("k1", [-0.15, 0.1])
def test_distorted_photos_are_undistorted_like_colmap_does(make_scene: MakeScene, k1: float) -> None:
    root = make_scene(3, camera=distorted(k1))
    before = sorted(root.rglob("*"))
    view = load_scene(root).views[0]
    model = pycolmap.Reconstruction(root / "sparse/0")
    options = pycolmap.UndistortCameraOptions()
    bitmap = pycolmap.Bitmap.read(root / "images/p00.png", True)
    expected, camera = pycolmap.undistort_image(options, bitmap, model.cameras[1])

    assert (view.camera.width, view.camera.height) == (camera.width, camera.height)
    np.testing.assert_allclose(view.camera.K.numpy(), camera.calibration_matrix(), rtol=1e-6)
    difference = view.read_photo().numpy().astype(int) - expected.to_array().astype(int)
    assert np.abs(difference)[1:-1, 1:-1].max() <= 2
    assert sorted(root.rglob("*")) == before  # nothing is written into the scene


@pytest.mark.parametrize(
    ("model", "further"),
    [("SIMPLE_FISHEYE", []), ("FISHEYE", [40.0]), ("OPENCV_FISHEYE", [40.0, 0, 0, 0, 0])],
)
def test_a_fisheye_without_coefficients_is_no_pinhole(model: str, further: list[float]) -> None:
    params = [40.0, *further[:1], 24.0, 16.0, *further[1:]]
    camera = pycolmap.Camera(model=model, width=W, height=H, params=params)
    source = PixelGrid.from_colmap(camera).source()
    assert source is not None
    grid = PixelGrid.from_colmap(camera)
    ray = torch.tensor([0.4, 0.0, 1.0], dtype=torch.float64)
    column = (grid.K @ ray)[0] / ray[2] - 0.5
    row = grid.K[1, 2] - 0.5
    in_photo = source[round(float(row)), round(float(column))]
    expected = 40 * np.arctan(0.4) + 24 - 0.5
    assert abs(in_photo[1] - expected) < 1


def test_masks_depth_and_truth_are_undistorted_with_the_photo(make_scene: MakeScene) -> None:
    root = make_scene(2, camera=distorted(-0.2))
    left = np.zeros((H, W), dtype=np.uint8)
    left[:, : W // 2] = 255
    for folder in ("masks", "truth/masks"):
        (root / folder).mkdir(parents=True)
        Image.fromarray(left).save(root / folder / "p00.png")
    (root / "depth").mkdir()
    Image.fromarray(left.astype(np.uint16) * 100).save(root / "depth/p00.png")
    (root / "truth/clean").mkdir()
    shutil.copy(root / "images/p00.png", root / "truth/clean/p00.png")

    view = load_scene(root, DataConfig(downscale=2)).views[0]
    shape = (view.camera.height, view.camera.width)
    column = view.camera.K[0, 2].round().int().item()  # the seam runs through the principal point
    for mask in (view.read_mask(), view.read_truth_mask()):
        assert mask is not None
        assert mask.shape == shape
        assert (mask[:, : column - 1] == 255).all()
        assert (mask[:, column + 1 :] == 0).all()
    disparity = view.read_disparity()
    assert disparity is not None
    assert disparity.shape == shape
    torch.testing.assert_close(
        disparity[:, : column - 1], torch.full_like(disparity[:, : column - 1], 25500 / 65535)
    )
    assert (disparity[:, column + 1 :] == 0).all()
    clean = view.read_clean()
    assert clean is not None
    assert torch.equal(clean, view.read_photo())


def test_masks_go_by_name_or_stem_and_depth_by_stem_in_subfolders(make_scene: MakeScene) -> None:
    root = make_scene(names=["a/x.png", "b/x.png", "c.png"])
    mask = Image.fromarray(np.tri(H, W, dtype=np.uint8))
    (root / "masks/a").mkdir(parents=True)
    mask.save(root / "masks/a/x.png.png")
    mask.save(root / "masks/c.png")
    (root / "depth/b").mkdir(parents=True)
    Image.fromarray(np.full((H, W), 65535, dtype=np.uint16)).save(root / "depth/b/x.png")

    a, b, c = load_scene(root).views
    assert [v.read_mask() is not None for v in (a, b, c)] == [True, False, True]
    disparity = b.read_disparity()
    assert disparity is not None
    assert (disparity == 1).all()
    assert a.read_disparity() is None
    without = load_scene(root, DataConfig(use_masks=False, use_depth=False)).views
    assert without[0].read_mask() is None
    assert without[1].read_disparity() is None


def test_transparent_pixels_join_the_mask(make_scene: MakeScene) -> None:
    root = make_scene(2)
    rgba = np.full((H, W, 4), 255, dtype=np.uint8)
    rgba[:, :5, 3] = 0
    Image.fromarray(rgba).save(root / "images/p01.png")
    (root / "masks").mkdir()
    mask = np.full((H, W), 255, dtype=np.uint8)
    mask[:3] = 0
    Image.fromarray(mask).save(root / "masks/p01.png")
    joined = load_scene(root).views[1].read_mask()
    expected = torch.full((H, W), 255, dtype=torch.uint8)
    expected[:3] = 0
    expected[:, :5] = 0
    assert joined is not None
    assert torch.equal(joined, expected)


def test_a_broken_mask_is_an_error_and_broken_depth_a_warning(make_scene: MakeScene) -> None:
    root = make_scene(2)
    for folder in ("masks", "depth"):
        (root / folder).mkdir()
        (root / folder / "p01.png").write_bytes(b"no picture")
    with pytest.warns(WildGSWarning, match=r"depth/p01\.png"):
        view = load_scene(root, DataConfig(use_masks=False)).views[1]
    assert view.read_disparity() is None
    with pytest.raises(UserError, match=r"masks/p01\.png.*remove it"):
        load_scene(root, DataConfig(use_depth=False))


def test_unreadable_photos_are_named_and_left_out(make_scene: MakeScene) -> None:
    root = make_scene(5)
    (root / "images/p03.png").write_bytes((root / "images/p03.png").read_bytes()[:90])
    (root / "images/p04.png").unlink()
    with pytest.warns(WildGSWarning, match=r"2 photos .*p03\.png .*p04\.png \(no such file\)"):
        scene = load_scene(root)
    assert [v.name for v in scene.views] == ["p00.png", "p01.png", "p02.png"]


def test_no_readable_photo_is_an_error(make_scene: MakeScene) -> None:
    root = make_scene(2)
    for path in (root / "images").iterdir():
        path.write_bytes(b"")
    with pytest.raises(UserError, match="no training photo can be read"):
        load_scene(root)


def test_broken_photos_do_not_move_the_world(make_scene: MakeScene) -> None:
    root = make_scene(5)
    before = load_scene(root).alignment
    (root / "images/p04.png").unlink()
    with pytest.warns(WildGSWarning):
        after = load_scene(root).alignment
    assert before.to_dict() == after.to_dict()


def test_one_photo_trains(make_scene: MakeScene) -> None:
    scene = load_scene(make_scene(1))
    assert len(scene.train_views) == 1
    assert torch.isfinite(scene.points).all()


@pytest.mark.parametrize(("holdout", "tests"), [(0, []), (3, [0, 3, 6]), (8, [0, 8])])
def test_holdout(make_scene: MakeScene, holdout: int, tests: list[int]) -> None:
    scene = load_scene(make_scene(9), DataConfig(holdout=holdout))
    assert [v.name for v in scene.test_views] == [f"p{i:02d}.png" for i in tests]


@pytest.mark.parametrize(
    "bad", [{"downscale": 0.5}, {"max_side": 0}, {"downscale": float("nan")}, {"holdout": 1}, {"holdout": -1}]
)
def test_senseless_settings_are_refused(bad: dict) -> None:
    with pytest.raises(UserError):
        DataConfig(**bad)


def test_progress_counts_photos(make_scene: MakeScene) -> None:
    seen: list[tuple[int, int]] = []
    load_scene(make_scene(3), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_points_that_are_no_numbers_are_dropped(make_scene: MakeScene) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    points[3, 1] = np.nan
    points[7, 2] = np.inf
    scene = load_scene(make_scene(3, points=points))
    assert scene.points.shape == (18, 3)
    assert scene.point_colors[:, 0].tolist() == [i for i in range(20) if i not in (3, 7)]


def test_a_scene_without_points_is_an_error(make_scene: MakeScene) -> None:
    with pytest.raises(UserError, match="no points"):
        load_scene(make_scene(3, points=np.zeros((0, 3))))


def test_missing_things_are_named(make_scene: MakeScene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere: no such folder"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(UserError, match="no COLMAP model"):
        load_scene(tmp_path)
    root = make_scene(2)
    (root / "sparse/0/images.bin").write_bytes(b"\xff" * 30)
    with pytest.raises(UserError, match=r"sparse/0: the COLMAP model cannot be read"):
        load_scene(root)
    shutil.rmtree(root / "images")
    with pytest.raises(UserError, match=r"images: no such folder"):
        load_scene(root)


def test_names_that_leave_the_scene_are_refused(make_scene: MakeScene) -> None:
    root = make_scene(2)
    (root / "sparse/0").rename(root / "old")
    model = pycolmap.Reconstruction(root / "old")
    model.images[1].name = "../../elsewhere.png"
    (root / "sparse/0").mkdir(parents=True)
    model.write(root / "sparse/0")
    with pytest.raises(UserError, match="outside the image folder"):
        load_scene(root)


def test_split_file_rules(make_scene: MakeScene, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene(names=["sub/a.png", "b.png", "c.png", "d.png"])
    rows = "a.png\t1.0\ttest\tx\nb.png\t2.0\ttrain\tx\nc.png\t\ttrain\tx\n"
    (root / "split.tsv").write_text(SPLIT + rows)
    with caplog.at_level(logging.INFO, logger="wildgs.scene"):
        scene = load_scene(root)
    assert [(v.name, v.split) for v in scene.views] == [("b.png", "train"), ("sub/a.png", "test")]
    assert "2 of 4 photos are not in split.tsv" in caplog.text


def test_a_split_that_names_missing_photos_warns_once(make_scene: MakeScene) -> None:
    root = make_scene(2)
    missing = "".join(f"m{i}.png\t{i}\ttrain\tx\n" for i in range(5))
    (root / "split.tsv").write_text(f"{SPLIT}p00.png\t1\ttest\tx\np01.png\t2\ttrain\tx\n{missing}")
    message = r"names 5 photos .*m0\.png, m1\.png, m2\.png and 2 more"
    with pytest.warns(WildGSWarning, match=message) as caught:
        scene = load_scene(root)
    assert len(caught) == 1
    assert len(scene.views) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SPLIT + "gone.png\t1\ttrain\tx\n", r"split\.tsv: the split leaves no training photo.*gone\.png"),
        (SPLIT + "p00.png\t1\ttest\tx\n", "leaves no training photo"),
        (SPLIT + "p00.png\t1\tvalidation\tx\n", "'validation'; it must be train or test"),
        ("name,split\np00.png,train\n", "tab-separated columns"),
        ("", "tab-separated columns"),
    ],
)
def test_useless_splits_are_errors(make_scene: MakeScene, text: str, message: str) -> None:
    root = make_scene(2)
    (root / "split.tsv").write_text(text)
    with pytest.raises(UserError, match=message):
        load_scene(root)


def test_two_split_files_are_an_error(make_scene: MakeScene) -> None:
    root = make_scene(2)
    for name in ("a.tsv", "b.tsv"):
        (root / name).write_text(SPLIT)
    with pytest.raises(UserError, match=r"a\.tsv, b\.tsv"):
        load_scene(root)


@pytest.mark.shared
def test_nerf_ws_own_splits_are_read(shared: Path) -> None:
    from wildgs.scene.split import read_split

    counts = {}
    for path in sorted((shared / "data/phototourism_splits").glob("*.tsv")):
        splits = list(read_split(path).values())
        counts[path.stem] = (splits.count("train"), splits.count("test"))
    assert counts == {"brandenburg": (763, 10), "sacre": (830, 21), "trevi": (1689, 19)}


@pytest.mark.shared
def test_gate_loads_upright_with_depth_and_truth(shared: Path) -> None:
    scene = load_scene(shared / "data/gate", DataConfig(downscale=2))
    assert (len(scene.train_views), len(scene.test_views)) == (90, 12)
    # The gate's own frame is z-up, so the alignment may only turn about z.
    assert scene.alignment.rotation[2, 2].item() > np.cos(np.radians(1))
    view = scene.test_views[0]
    assert max(view.camera.width, view.camera.height) == 240
    clean, truth, disparity = view.read_clean(), view.read_truth_mask(), view.read_disparity()
    assert clean is not None
    assert clean.shape == view.read_photo().shape
    assert truth is not None
    assert truth.shape == clean.shape[:2]
    assert disparity is not None
    assert 0 <= disparity.min() < disparity.max() <= 1
    same = (clean.int() - view.read_photo().int()).abs().float().mean(dim=-1)
    assert same[truth == 255].mean() < same[truth == 0].mean()


@pytest.mark.shared
def test_liberty_loads(shared: Path) -> None:
    scene = load_scene(shared / "data/liberty", DataConfig(downscale=4))
    assert (len(scene.train_views), len(scene.test_views)) == (86, 12)
    # Half of the points lie within the unit of depth, and the statue stands upright: z is its longest side.
    spread = scene.points.quantile(0.9, dim=0) - scene.points.quantile(0.1, dim=0)
    assert spread.argmax().item() == 2


def test_a_mask_may_have_the_photos_own_name(make_scene: MakeScene) -> None:
    root = make_scene(names=["x.jpg", "y.jpg"])
    (root / "masks").mkdir()
    Image.new("L", (W, H), 0).save(root / "masks" / "x.jpg")
    with pytest.warns(
        WildGSWarning, match=r"1 training photos are masked comp.*x\.jpg.*0 = ignore the pixel"
    ):
        first, second = load_scene(root, DataConfig(holdout=0)).views
    mask = first.read_mask()
    assert mask is not None
    assert not mask.any()
    assert second.read_mask() is None


def test_depth_may_have_the_photos_whole_name(make_scene: MakeScene) -> None:
    root = make_scene(names=["a.png", "b.jpg", "b.png"])
    (root / "depth").mkdir()
    for name in ("a.png.png", "b.png.png", "b.png"):
        Image.fromarray(np.full((H, W), 65535, dtype=np.uint16)).save(root / "depth" / name)
    with pytest.warns(WildGSWarning, match=r"depth: 1 files .* not used: b\.png"):
        views = load_scene(root).views
    assert [view.read_disparity() is not None for view in views] == [True, False, True]


@pytest.mark.parametrize("folder", ["masks", "depth"])
def test_files_of_no_photo_are_named(make_scene: MakeScene, folder: str) -> None:
    """A mask that is not read, for its name alone, would train what it should hide."""
    root = make_scene(3)
    (root / folder).mkdir()
    load_scene(root)
    picture = Image.linear_gradient("L").resize((W, H))
    for name in ("p00.png", "p1.png", "p02.PNG", ".hidden.png"):
        picture.save(root / folder / name)
    with pytest.warns(WildGSWarning, match=rf"{folder}: 2 files .* not used: p02\.PNG, p1\.png"):
        load_scene(root)
    load_scene(root, DataConfig(use_masks=folder != "masks", use_depth=folder != "depth"))


def test_masks_of_photos_without_a_pose_are_no_mistake(make_scene: MakeScene) -> None:
    root = make_scene(3)
    (root / "masks").mkdir()
    Image.fromarray(photo()).save(root / "images" / "unregistered.png")
    Image.linear_gradient("L").resize((W, H)).save(root / "masks" / "unregistered.png")
    scene = load_scene(root)  # no warning
    assert len(scene.views) == 3
    assert all(view.read_mask() is None for view in scene.views)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("kind", ["pipe", "folder", "link to nothing"])
def test_what_takes_the_place_of_a_mask_or_depth_is_reported(make_scene: MakeScene, kind: str) -> None:
    root = make_scene(3)
    for folder in ("masks", "depth"):
        path = root / folder / "p01.png"
        path.parent.mkdir()
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to(root / "nowhere")
    with pytest.raises(UserError, match=r"masks/p01\.png: (not a regular|no such) file; repair the mask"):
        load_scene(root, DataConfig(use_depth=False))
    with pytest.warns(WildGSWarning, match=r"depth/p01\.png: .*trains without depth"):
        load_scene(root, DataConfig(use_masks=False, holdout=0))


def test_photos_that_are_shrunk_to_nothing_are_an_error(make_scene: MakeScene) -> None:
    with pytest.raises(UserError, match=r"pixels are too few; lower --downscale or"):
        load_scene(make_scene(3), DataConfig(downscale=1000))


@pytest.mark.parametrize("target", ["pipe", "/dev/zero"])
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_split_that_never_ends_is_refused(make_scene: MakeScene, target: str) -> None:
    root = make_scene(3)
    if target == "pipe":
        os.mkfifo(root / "split.tsv")
    else:
        (root / "split.tsv").symlink_to(target)
    with pytest.raises(UserError, match=r"split\.tsv.*not a regular file"):
        load_scene(root)


def test_names_as_long_as_the_file_system_takes(make_scene: MakeScene) -> None:
    """`masks/<name>.png` is longer than a name can be."""
    name = "x" * 250 + ".png"
    scene = load_scene(make_scene(names=[name, "b.png"]), DataConfig(holdout=0))
    assert [view.name for view in scene.views] == ["b.png", name]
    assert scene.views[1].read_mask() is None


def test_observations_are_those_of_the_model(make_scene: MakeScene) -> None:
    root = make_scene(4)
    (root / "images" / "p01.png").unlink()
    with pytest.warns(WildGSWarning, match=r"p01\.png"):
        scene = load_scene(root)
    pairs = {tuple(pair) for pair in scene.observations.tolist()}
    assert pairs == {(view, point) for view in range(3) for point in range(60)}


def write_metric_depth(root: Path, scene: Scene, factor: float) -> None:
    """Depth of a plane through the points of each photo, in units of the model."""
    (root / "depth").mkdir(exist_ok=True)
    for view in scene.views:
        z = view.camera.project(scene.points)[1].median() / scene.alignment.scale
        Image.fromarray(np.full((H, W), factor * float(z), np.float32)).save(
            root / f"depth/{view.name[:3]}.tiff"
        )


@pytest.mark.parametrize("factor", [3.3, 0.3])
def test_metric_depth_in_other_units_is_refused(make_scene: MakeScene, factor: float) -> None:
    """Metres, or the units of a model that was replaced, would put Gaussians where there is nothing."""
    root = make_scene(4)
    scene = load_scene(root)
    write_metric_depth(root, scene, 1.0)
    load_scene(root)
    write_metric_depth(root, scene, factor)
    assert load_scene(root, DataConfig(use_metric_depth=False)).views[0].read_depth() is None
    with pytest.raises(UserError, match=rf"metric depth \(.tiff\) is {int(factor)}[.\d]* times the depth"):
        load_scene(root)
    load_scene(root, DataConfig(use_depth=False))


def test_what_metric_depth_may_hold(make_scene: MakeScene, tmp_path: Path) -> None:
    root = make_scene(6)
    scene = load_scene(root)
    write_metric_depth(root, scene, 1.0)
    values = np.array(Image.open(root / "depth/p01.tiff"))
    values[0, :4] = [np.nan, np.inf, -1, 3e38]
    Image.fromarray(values).save(root / "depth/p01.tiff")
    Image.fromarray(np.full((H, W), 9, np.uint16)).save(root / "depth/p02.tiff")
    Image.fromarray(values[:, :9]).save(root / "depth/p03.tiff")
    (root / "depth/p04.tiff").write_bytes(b"no picture")
    (root / "depth/p05.tiff").write_bytes(b"")
    with pytest.warns(WildGSWarning) as said:
        loaded = load_scene(root, DataConfig(holdout=0))
    assert len(said) == 4
    assert all("trains without depth" in str(each.message) for each in said)
    depth = [view.read_depth() for view in loaded.views]
    assert depth[0] is not None
    assert depth[1] is not None
    assert depth[2:] == [None] * 4
    assert depth[1].isfinite().all()
    assert (depth[1][0, :3] == 0).all()
