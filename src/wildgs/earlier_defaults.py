"""Options that earlier versions did not have: the values with which their runs behave as before."""

from __future__ import annotations

import copy
from typing import Any

EARLIER_DEFAULTS: dict[tuple[str, ...], tuple[str, Any]] = {
    ("model", "matched_loss"): ("color_match", 0.0),
    ("model", "camera_response"): ("color_match", {"vignetting": False, "curve": False}),
    ("model", "light_codes"): ("color_match", 0),
    ("model", "light_components"): ("color_match", 0),
    ("model", "embedding_scale"): ("color_match", 1.0),
    ("model", "local_embeddings"): ("wrapping", True),
    ("model", "eps2d"): ("wrapping", 0.3),
    ("model", "antialiased"): ("wrapping", False),
    ("model", "sky", "densify"): ("lowest", True),
    ("model", "sky", "own_fusion"): ("lowest", False),
    ("model", "sky", "complete"): ("lowest", False),
    ("model", "ground", "most_pixels"): ("spacing", 0.0),
    ("train", "optimizer", "short_runs"): ("batch_scaling", 0.0),
    ("train", "objective", "mask_weight_photos"): ("mask_weight_end", 0),
    ("train", "objective", "mask_power"): ("mask_weight_end", 1.0),
    ("train", "objective", "consensus"): ("mask_weight_end", False),
    ("train", "objective", "free_space"): ("mask_weight_end", False),
    ("train", "objective", "sky_weight"): ("mask_weight_end", 0.0),
    ("train", "objective", "opaque_weight"): ("mask_weight_end", 0.0),
    ("train", "density", "min_visibility"): ("least_pixels", 0.5),
    ("train", "density", "prune_share"): ("grow_share", 0.1),
    ("train", "schedule", "mask_every"): ("mask_pause", 1),
    ("train", "schedule", "planes_every"): ("mask_pause", 1),
    ("train", "schedule", "mask_visits"): ("mask_pause", 0),
    ("train", "dropout"): ("density", {"rate": 0.0}),
    ("train", "flat_ground"): ("density", {"rate": 0.0}),
    ("train", "flat_ground", "level"): ("rate", False),
    ("train", "warp"): ("density", {"rate": 0.0, "residuals": False}),
    ("train", "warp", "residuals"): ("rate", False),
    ("train", "density", "strategy"): ("split_scale", "classic"),
}
"""Entries that were added later: path -> (a sibling by which an older file is recognised, the older behaviour)."""


def with_earlier_defaults(plain: dict[Any, Any]) -> dict[Any, Any]:
    """Adds missing entries to an earlier version's configuration, with values that keep its behaviour.

    Args:
        plain: Contents of `config.yaml`; not changed.
    """
    plain = copy.deepcopy(plain)
    for (*parents, name), (sibling, value) in EARLIER_DEFAULTS.items():
        entries: Any = plain
        for parent in parents:
            entries = entries.get(parent) if isinstance(entries, dict) else None
        if isinstance(entries, dict) and sibling in entries:
            entries.setdefault(name, value)
    return plain
