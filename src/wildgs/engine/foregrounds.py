"""What training photos show in free space, found when the mask is first trained."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.priors.free_space import find_foregrounds
from wildgs.progress import Counter
from wildgs.scene import Scene


class Foregrounds:
    """Evidence for masks by depth priors; see `wildgs.priors.free_space`.

    Attributes:
        steps: Number of steps in which it is needed.
        on_photo: Called with (photos done, total number of photos) while depth maps are read.
    """

    def __init__(self, scene: Scene, device: torch.device, steps: int) -> None:
        """Compares nothing yet.

        Args:
            scene: The scene.
            device: Device of the maps.
            steps: Number of steps in which masks are trained by evidence.
        """
        self.steps = steps
        self.on_photo: Counter = lambda done, total: None
        self._scene = scene
        self._device = device
        self._found: dict[str, Float[Tensor, "_ _"]] | None = None

    def of(self, name: str, step: int) -> Float[Tensor, "_ _"] | None:
        """Degree to which a photo shows something in free space, in cells; None if unknown or not needed.

        The first call reads the depth maps of all training photos.

        Args:
            name: Name of the photo.
            step: Number of steps taken.
        """
        if step >= self.steps:
            return None
        if self._found is None:
            found = find_foregrounds(self._scene, self.on_photo)
            self._found = {name: each.to(self._device) for name, each in found.items()}
        return self._found.get(name)
