"""The order in which photos train: shuffled, every photo once a round."""

from __future__ import annotations

import torch
from torch import Tensor


class ViewSampler:
    """Endless shuffled rounds over `count` views, with a state that can be saved."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count = count
        self._generator = generator
        self.order = torch.empty(0, dtype=torch.int64)
        self.position = 0

    def next(self) -> int:
        """The next view's index."""
        return self.take(1)[0]

    def take(self, count: int) -> list[int]:
        """The next `count` views' indices, all different; at most as many as there are views."""
        taken = self.upcoming(count)
        self.position += len(taken)
        missing = count - len(taken)
        if missing:
            order = torch.randperm(self.count, generator=self._generator)
            if taken:  # a round may not begin with the photos that end the one before, in the same step
                repeated = torch.isin(order, torch.tensor(taken))
                fresh = order[~repeated]
                order = torch.cat([fresh[:missing], order[repeated], fresh[missing:]])
            self.order = order
            self.position = missing
            taken += order[:missing].tolist()
        return taken

    def upcoming(self, count: int) -> list[int]:
        """The next views' indices, as far as this round is drawn."""
        return self.order[self.position : self.position + count].tolist()

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs."""
        return {"order": self.order.clone(), "position": torch.tensor(self.position)}

    def restore(self, state: dict[str, Tensor]) -> bool:
        """Goes on where `state` was taken; a round over another number of photos is drawn anew.

        Returns:
            Whether it goes on in the same order.
        """
        same = len(state["order"]) in (0, self.count)
        self.order = state["order"] if same else torch.empty(0, dtype=torch.int64)
        self.position = int(state["position"]) if same else 0
        return same
