from dataclasses import replace

import pytest

from wildgs.sfm.placement import Placement
from wildgs.sfm.report import FEW_POINTS, SfmReport

REPORT = SfmReport(
    photos=6,
    registered=("a.jpg", "b.jpg"),
    left_out={
        "x.jpg": "another place",
        "y.jpg": "another place",
        "z.jpg": "another place",
        "w.jpg": "blurred",
    },
    points=100,
    reprojection_error=0.5,
    pairing="exhaustive",
    pairs=15,
    models=(2,),
    seconds=1.0,
)


def test_another_place_is_one_line_instead_of_a_line_per_photo() -> None:
    lines = replace(REPORT, other_places=(("x.jpg", "y.jpg", "z.jpg"),)).lines()
    assert sum("another place" in line for line in lines) == 1
    assert any("3 photos form another place" in line and "x.jpg, y.jpg, z.jpg" in line for line in lines)
    assert "  w.jpg: blurred" in lines


def test_photos_without_a_group_have_a_line_each() -> None:
    assert sum(line.endswith(": another place") for line in REPORT.lines()) == 3


@pytest.mark.parametrize(("points", "doubted"), [([10, FEW_POINTS - 1, 400], True), ([10, 60, 70], False)])
def test_few_points_per_photo_are_said(points: list[int], doubted: bool) -> None:
    placed = {f"{row}.jpg": Placement("first", count, 0.5, 2) for row, count in enumerate(points)}
    lines = replace(REPORT, placed=placed).lines()
    said = [line for line in lines if "half of the photos observe no more than" in line]
    assert bool(said) == doubted
    assert not doubted or f"no more than {FEW_POINTS - 1} of the points" in said[0]


def test_cropped_and_stretched_photos_are_named() -> None:
    assert not any("cropped" in line for line in REPORT.lines())
    lines = replace(REPORT, edited={"b.jpg": "cropped: …", "a.jpg": "stretched: …"}).lines()
    assert any(
        "2 of the photos with a pose were cropped or stretched" in line and "a.jpg, b.jpg" in line
        for line in lines
    )
