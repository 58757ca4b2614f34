from wildgs.sfm.placement import Failure, find_groups, other_places


def test_photos_that_match_each_other_alone_form_a_group() -> None:
    matches = {(0, 1): 500, (1, 2): 90, (2, 3): 40, (4, 5): 29, (3, 6): 12, (5, 7): 35}
    groups = find_groups([1, 2, 3, 4, 5, 6], matches)
    assert [sorted(groups[photo]) for photo in (1, 2, 3)] == [[1, 2, 3]] * 3  # 0 has a pose
    assert [groups[photo] for photo in (4, 5, 6)] == [
        [4],
        [5],
        [6],
    ]  # matches by chance, and with 7, which has one


def test_groups_that_a_later_pair_links_become_one() -> None:
    groups = find_groups([0, 1, 2, 3], {(0, 1): 50, (2, 3): 50, (1, 3): 50})
    assert all(sorted(group) == [0, 1, 2, 3] for group in groups.values())


def test_photos_of_a_smaller_model_form_a_group() -> None:
    groups = find_groups([1, 2, 3, 4, 5], {(3, 4): 50}, [[1, 2, 3]])  # few matches each, but one model
    assert sorted(groups[1]) == sorted(groups[4]) == [1, 2, 3, 4]
    assert groups[5] == [5]


def test_other_places_are_listed_once_and_the_largest_first() -> None:
    small, large = ("x", "y", "z"), ("a", "b", "c", "d")
    failed = [Failure("", None, group) for group in (small, large, small, ())]
    assert other_places(failed) == (large, small)
