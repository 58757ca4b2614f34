from dataclasses import replace

from wildgs.sfm.report import SfmReport

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
