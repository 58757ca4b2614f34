"""Light that changes over a video: looks one after the other, mixed in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wildgs.errors import UserError
from wildgs.light.look import Look, mix


@dataclass(frozen=True)
class Timeline:
    """Looks at even distances over time; between two of them their mix.

    Attributes:
        looks: At least one; a single one does not change.
    """

    looks: tuple[Look, ...]

    def __post_init__(self) -> None:
        """Refuse what shows nothing."""
        if not self.looks:
            raise UserError("a video needs at least one appearance")

    @classmethod
    def of(cls, looks: Look | Sequence[Look]) -> Timeline:
        """One look, or several over time."""
        return cls((looks,) if isinstance(looks, Look) else tuple(looks))

    def at(self, share: float) -> Look:
        """The look at a share of the time, from 0 to 1.

        At the looks themselves no mixing and no new shading takes place.
        """
        position = min(max(share, 0.0), 1.0) * (len(self.looks) - 1)
        index = min(int(position), max(len(self.looks) - 2, 0))
        amount = position - index
        if amount < 1e-9:
            return self.looks[index]
        if amount > 1 - 1e-9:
            return self.looks[index + 1]
        return mix([self.looks[index], self.looks[index + 1]], [1 - amount, amount])
