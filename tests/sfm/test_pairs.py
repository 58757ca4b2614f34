import numpy as np
import pytest
import torch

from wildgs.sfm.pairs import (
    PairingConfig,
    choose_pairs,
    exhaustive_pairs,
    friends_of_friends,
    near_pairs,
    vlad_descriptors,
)


def descriptors_of_places(photos: int, places: int) -> list[np.ndarray]:
    """SIFT-like descriptors; photo i shows place i % places, every third feature is its own."""
    rng = np.random.default_rng(0)
    words = rng.integers(0, 120, (places, 40, 128))
    result = []
    for photo in range(photos):
        shown = words[photo % places] + rng.integers(-8, 8, (40, 128))
        other = rng.integers(0, 120, (20, 128))
        result.append(np.concatenate([shown, other]).clip(0, 255).astype(np.uint8))
    return result


def test_sets_of_few_features_are_matched_all_with_all() -> None:
    pairing = choose_pairs(torch.zeros(5, 128), {}, PairingConfig(), 500_000)
    assert pairing == exhaustive_pairs(5)
    assert len(pairing.pairs) == 10


def test_retrieval_finds_photos_of_the_same_place() -> None:
    photos, places = 60, 6
    features = descriptors_of_places(photos, places)
    config = PairingConfig(exhaustive_features=500, neighbours=9)
    pairing = choose_pairs(vlad_descriptors(photos, features.__getitem__), {}, config, 501)
    assert pairing.name == "retrieval"
    assert np.mean([a % places == b % places for a, b in pairing.pairs]) > 0.95
    assert list(pairing.pairs) == sorted(set(pairing.pairs))
    assert all(a < b for a, b in pairing.pairs)


@pytest.mark.parametrize("photos", [40, 80])
def test_pairs_grow_with_the_photos_not_with_their_square(photos: int) -> None:
    features = descriptors_of_places(photos, photos // 4)
    config = PairingConfig(exhaustive_features=500, neighbours=5)
    assert (
        len(choose_pairs(vlad_descriptors(photos, features.__getitem__), {}, config, 501).pairs) <= 5 * photos
    )


def test_photos_without_features_do_not_disturb() -> None:
    features = [np.zeros((0, 128), np.uint8), *descriptors_of_places(12, 3)]
    vlads = vlad_descriptors(13, features.__getitem__)
    assert torch.isfinite(vlads).all()
    assert (vlads[0] == 0).all()
    torch.testing.assert_close(vlads[1:].norm(dim=1), torch.ones(12))
    empty = vlad_descriptors(2, lambda photo: np.zeros((0, 128), np.uint8))
    assert (empty == 0).all()


def test_gps_neighbours_cross_the_date_line_and_keep_their_distance() -> None:
    places = {0: (0.0, 179.9999), 1: (0.0, -179.9999), 4: (0.0, 179.0), 7: (0.0, 179.9995)}
    pairs = near_pairs(places, neighbours=3, max_distance=100.0)
    # One ten-thousandth of a degree at the equator is 11 m.
    assert pairs == {(0, 1), (0, 7), (1, 7)}
    assert near_pairs(places, neighbours=1, max_distance=100.0) == {(0, 1), (0, 7)}
    assert near_pairs({3: (1.0, 1.0)}, neighbours=4, max_distance=100.0) == set()


def test_gps_counts_where_enough_photos_carry_it() -> None:
    photos = 30
    features = descriptors_of_places(photos, 3)
    config = PairingConfig(exhaustive_features=500, neighbours=4, gps_share=0.8)
    line = {photo: (45.0, 7.0 + 1e-4 * photo) for photo in range(photos)}
    pairing = choose_pairs(vlad_descriptors(photos, features.__getitem__), line, config, 501)
    assert pairing.name == "gps"
    assert all((photo, photo + 1) in pairing.pairs for photo in range(photos - 1))

    mostly = {photo: place for photo, place in line.items() if photo != 13}
    pairs = choose_pairs(vlad_descriptors(photos, features.__getitem__), mostly, config, 501).pairs
    partners = [a + b - 13 for a, b in pairs if 13 in (a, b)]
    assert len(partners) >= 4  # the photo without a position is found by its looks
    few = {photo: line[photo] for photo in range(10)}
    assert choose_pairs(vlad_descriptors(photos, features.__getitem__), few, config, 501).name == "retrieval"


def test_friends_of_friends_are_those_with_the_strongest_links() -> None:
    matched = {(0, 1): 50, (1, 2): 40, (1, 3): 200, (3, 4): 300, (5, 6): 90}
    assert friends_of_friends([0], matched, 5) == {(0, 2), (0, 3)}
    assert friends_of_friends([0], matched, 1) == {(0, 3)}
    assert friends_of_friends([4], matched, 5) == {(1, 4)}
    assert friends_of_friends([7, 5], matched, 5) == set()
