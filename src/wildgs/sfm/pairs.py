"""Selection of image pairs: exhaustive for sets of few features, else neighbours; and indirect neighbours.

Neighbours are found by GPS position if enough photos have one, else by retrieval with VLAD descriptors (Jegou et
al., "Aggregating local descriptors into a compact image representation", CVPR 2010) of SIFT features, for which no
vocabulary has to be downloaded.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.sfm.config import PairingConfig

PairingName = Literal["exhaustive", "gps", "retrieval"]
Pair = tuple[int, int]
"""Indices of two photos, the lower first."""

EARTH_RADIUS = 6_371_000.0
VLAD_WORDS = 64
VLAD_FEATURES = 1000
"""Number of descriptors per photo for retrieval."""
VLAD_TRAINING = 100_000
"""Number of descriptors, over all photos, for clustering the visual words."""


@dataclass(frozen=True)
class Pairing:
    """Pairs of photos to match, sorted and unique, and how they were selected."""

    name: PairingName
    pairs: tuple[Pair, ...]


def exhaustive_pairs(count: int) -> Pairing:
    """All pairs."""
    return Pairing("exhaustive", tuple(combinations(range(count), 2)))


def alike_pairs(vlads: Float[Tensor, "N D"], partners: Mapping[int, int]) -> set[Pair]:
    """Pairs each photo with the most similar ones by their unit vectors; `partners` is their number by photo."""
    pairs = set()
    for photo, wanted in partners.items():
        likeness = vlads @ vlads[photo]
        likeness[photo] = -torch.inf
        best = torch.topk(likeness, min(wanted, len(vlads) - 1)).indices.tolist()
        pairs.update((min(photo, other), max(photo, other)) for other in best)
    return pairs


def vlad_descriptors(
    count: int, read_descriptors: Callable[[int], Shaped[np.ndarray, "F 128"]], seed: int = 0
) -> Float[Tensor, "N D"]:
    """One unit vector per photo: SIFT residuals from the nearest visual words, normalised per word.

    Args:
        count: Number of photos.
        read_descriptors: Returns the SIFT descriptors of a photo, most reliable first (COLMAP sorts by scale); may
            be empty.
        seed: Random seed of the clustering of visual words.
    """
    generator = torch.Generator().manual_seed(seed)
    share = max(1, VLAD_TRAINING // max(count, 1))
    training = []
    for photo in range(count):
        features = _root_sift(read_descriptors(photo))
        training.append(features[torch.randperm(len(features), generator=generator)[:share]])
    samples = torch.cat(training)
    words = _k_means(samples, min(VLAD_WORDS, max(len(samples), 1)), generator)
    return torch.stack([_vlad(_root_sift(read_descriptors(photo)), words) for photo in range(count)])


def _root_sift(descriptors: Shaped[np.ndarray, "F 128"]) -> Float[Tensor, "G 128"]:
    features = torch.from_numpy(descriptors[:VLAD_FEATURES].astype(np.float32))
    return torch.nn.functional.normalize(features, dim=1)


def _k_means(
    samples: Float[Tensor, "S 128"], words: int, generator: torch.Generator, rounds: int = 12
) -> Float[Tensor, "K 128"]:
    if len(samples) == 0:
        return torch.zeros(1, 128)
    centres = samples[torch.randperm(len(samples), generator=generator)[:words]].clone()
    for _ in range(rounds):
        nearest = _nearest_word(samples, centres)
        sums = torch.zeros_like(centres).index_add_(0, nearest, samples)
        counts = torch.bincount(nearest, minlength=len(centres))
        centres = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1)[:, None], centres)
    return centres


def _nearest_word(features: Float[Tensor, "F 128"], words: Float[Tensor, "K 128"]) -> Shaped[Tensor, "F"]:
    chunks = [torch.cdist(chunk, words).argmin(dim=1) for chunk in features.split(16_384)]
    return torch.cat(chunks) if chunks else torch.zeros(0, dtype=torch.int64)


def _vlad(features: Float[Tensor, "F 128"], words: Float[Tensor, "K 128"]) -> Float[Tensor, "D"]:
    residuals = torch.zeros_like(words)
    if len(features):
        nearest = _nearest_word(features, words)
        residuals.index_add_(0, nearest, features - words[nearest])
    per_word = torch.nn.functional.normalize(residuals, dim=1)
    return torch.nn.functional.normalize(per_word.flatten(), dim=0)


def near_pairs(
    positions: Mapping[int, tuple[float, float]], neighbours: int, max_distance: float
) -> set[Pair]:
    """Pairs each photo with the nearest ones by GPS position.

    Args:
        positions: Latitude and longitude in degrees of the photos that have them.
        neighbours: Number of neighbours per photo.
        max_distance: Largest distance of neighbours, metres.
    """
    photos = sorted(positions)
    if len(photos) < 2:
        return set()
    # Distances in 3D, which have no discontinuities at the date line and the poles.
    angles = np.radians(np.array([positions[photo] for photo in photos], dtype=np.float64))
    latitude, longitude = angles[:, 0], angles[:, 1]
    places = EARTH_RADIUS * np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
    found = KDTree(places).query(places, k=min(neighbours + 1, len(photos)))
    distances, partners = np.asarray(found[0]), np.asarray(found[1])
    pairs = set()
    for row, photo in enumerate(photos):
        for distance, partner in zip(distances[row], partners[row], strict=True):
            other = photos[int(partner)]
            if other != photo and distance <= max_distance:
                pairs.add((min(photo, other), max(photo, other)))
    return pairs


def friends_of_friends(photos: Iterable[int], matched: Mapping[Pair, int], limit: int) -> set[Pair]:
    """Pairs photos with those that share a matching photo, which retrieval may have missed.

    Args:
        photos: Photos to find partners for.
        matched: Number of matches of verified pairs.
        limit: Upper bound on new partners per photo, ordered by the number of matches of the weaker of the two
            links.
    """
    partners: dict[int, dict[int, int]] = defaultdict(dict)
    for (a, b), matches in matched.items():
        partners[a][b] = partners[b][a] = matches
    pairs = set()
    for photo in photos:
        links: Counter[int] = Counter()
        for friend, matches in partners[photo].items():
            for other, more in partners[friend].items():
                if other != photo and other not in partners[photo]:
                    links[other] = max(links[other], min(matches, more))
        pairs.update((min(photo, other), max(photo, other)) for other, _ in links.most_common(limit))
    return pairs


def choose_pairs(
    vlads: Float[Tensor, "N D"],
    positions: Mapping[int, tuple[float, float]],
    config: PairingConfig,
    features: int,
) -> Pairing:
    """Selects all pairs of a set with few features, or each photo's neighbours by GPS or retrieval of a large one.

    With GPS, a quarter of the neighbours are still found by retrieval, because photos of the same building may be
    taken far apart; photos without GPS neighbours get all of them by retrieval.

    Args:
        vlads: VLAD descriptors of all photos.
        positions: Latitude and longitude in degrees of the photos that have them.
        config: Limits.
        features: Total number of features of the photos.
    """
    count = len(vlads)
    if features <= config.exhaustive_features:
        return exhaustive_pairs(count)
    near: set[Pair] = set()
    if len(positions) >= config.gps_share * count:
        near = near_pairs(positions, config.neighbours, config.gps_distance)
    placed = {photo for pair in near for photo in pair}
    partners = {
        photo: max(1, config.neighbours // 4) if photo in placed else config.neighbours
        for photo in range(count)
    }
    alike = alike_pairs(vlads, partners)
    return Pairing("gps" if near else "retrieval", tuple(sorted(near | alike)))
