"""Input of training: photos in shuffled epochs, with their masks, depth maps and cameras on the device."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wildgs.engine.device_cache import DeviceCache
from wildgs.engine.team import Team
from wildgs.errors import UserError, WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.priors.depth_points import aligned_depth, known_depth
from wildgs.priors.sky_pixels import find_sky_pixels
from wildgs.scene import Scene, View
from wildgs.scene.image_cache import AHEAD
from wildgs.scene.scene import converted, observed_pixels


class ViewSampler:
    """Endless shuffled epochs over `count` views, with a state that can be saved."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count = count
        self._generator = generator
        self.order = torch.empty(0, dtype=torch.int64)
        self.position = 0

    def next(self) -> int:
        """The index of the next view."""
        return self.take(1)[0]

    def take(self, count: int) -> list[int]:
        """Indices of the next `count` views, all different; `count` is at most the number of views."""
        taken = self.upcoming(count)
        self.position += len(taken)
        missing = count - len(taken)
        if missing:
            order = torch.randperm(self.count, generator=self._generator)
            if taken:  # an epoch must not start with photos of the previous one that are in the same step
                repeated = torch.isin(order, torch.tensor(taken))
                fresh = order[~repeated]
                order = torch.cat([fresh[:missing], order[repeated], fresh[missing:]])
            self.order = order
            self.position = missing
            taken += order[:missing].tolist()
        return taken

    def upcoming(self, count: int) -> list[int]:
        """Indices of the next views, as far as this epoch is shuffled."""
        return self.order[self.position : self.position + count].tolist()

    def state(self) -> dict[str, Tensor]:
        """The state for `restore`."""
        return {"order": self.order.clone(), "position": torch.tensor(self.position)}

    def restore(self, state: dict[str, Tensor]) -> bool:
        """Continues from `state`; False if the number of photos has changed, so that they are shuffled again."""
        same = len(state["order"]) in (0, self.count)
        self.order = state["order"] if same else torch.empty(0, dtype=torch.int64)
        self.position = int(state["position"]) if same else 0
        return same


class PhotoFeed:
    """Photos in the order of training, for one rank of a team.

    Attributes:
        batch: Names of the photos that all ranks train on now.
    """

    def __init__(
        self,
        views: Sequence[View],
        sampler: ViewSampler,
        team: Team,
        device: torch.device,
        scene: Scene | None = None,
    ) -> None:
        """Creates the feed.

        Args:
            views: Training photos.
            sampler: Their order.
            team: The processes that train.
            device: Device of the training.
            scene: The scene of the photos, whose sparse points `observations` and `sky` need.
        """
        self.views = views
        self.sampler = sampler
        self.team = team
        self.device = device
        self.batch = ""
        self._scene = scene
        observed = {} if scene is None else observed_pixels(scene)
        self._observations = {name: pixels.to(device) for name, pixels in observed.items()}
        self._unreadable: set[str] = set()
        self._cameras: dict[str, Camera] = {}
        self._sky: dict[str, Bool[Tensor, "_ _"]] = {}
        self._with_prior: set[str] = set()
        self._kept = DeviceCache(device)

    def next_view(self) -> View:
        """The next readable photo; starts decoding the following ones in the background.

        Raises:
            UserError: No photo can be read.
        """
        for index in self._candidates():
            view = self.views[index]
            if self.is_readable(view):
                return view
        raise UserError(
            f"the photos cannot be read any more ({', '.join(sorted(self._unreadable)[:3])}); restore them"
        )

    def _candidates(self) -> Iterator[int]:
        """This rank's next photo, then its replacements; the sampler advances equally on all ranks."""
        size, rank = self.team.size, self.team.rank
        for _ in range(len(self.views)):
            batch = self.sampler.take(size)
            self.batch = ", ".join(self.views[index].name for index in batch)
            for index in self.sampler.upcoming(AHEAD * size)[rank::size]:
                if ("photo", self.views[index].name) not in self._kept:
                    self.views[index].prefetch()
            yield batch[rank]
            if size > 1:
                following = range(batch[rank] + 1, batch[rank] + len(self.views))
                yield from (i % len(self.views) for i in following if i % len(self.views) not in batch)
                return

    def is_readable(self, view: View) -> bool:
        """Whether a photo can still be read, or need not be; warns once if not."""
        if ("photo", view.name) in self._kept:
            return True
        try:
            view.read_photo()
        except UserError as error:
            if view.name not in self._unreadable:
                self._unreadable.add(view.name)
                warnings.warn(f"{error} (training continues without it)", WildGSWarning, stacklevel=3)
            return False
        return True

    def photo(self, view: View) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"] | None]:
        """The photo and its valid pixels, see `View.load`."""
        pixels = self._kept.get("photo", view.name, view.read_photo)
        mask = self._kept.get("mask", view.name, view.read_mask)
        assert pixels is not None
        return converted(pixels, mask)

    def disparity(self, view: View) -> Float[Tensor, "H W"] | None:
        """The disparity map of the photo, if there is one."""
        return self._kept.get("disparity", view.name, view.read_disparity)

    def depth(self, view: View) -> Float[Tensor, "H W"] | None:
        """The metric depth map of the photo, if there is one."""
        return self._kept.get("depth", view.name, view.read_depth)

    def observations(self, view: View) -> Float[Tensor, "K 2"] | None:
        """Pixels (x, y) of the photo's triangulated points, if known."""
        return self._observations.get(view.name)

    def sky(self, view: View) -> Bool[Tensor, "H W"]:
        """Pixels of the photo that certainly show sky; found once at low resolution."""
        if view.name not in self._sky:
            assert self._scene is not None
            maps = aligned_depth(self._scene, view, torch.Generator())
            found = find_sky_pixels(view.read_photo(), view.camera, self._scene.points, known_depth(maps))
            self._sky[view.name] = found.to(self.device)
            if maps[1] is not None:
                self._with_prior.add(view.name)
        small = self._sky[view.name].float()[None, None]
        return functional.interpolate(small, size=(view.camera.height, view.camera.width))[0, 0] > 0.5

    def tells_sky_from_walls(self, view: View) -> bool:
        """Whether a depth prior told the photo's `sky` from plain walls nearby, such as arches."""
        return view.name in self._with_prior

    def camera(self, view: View) -> Camera:
        """The camera, cached on the device."""
        if view.name not in self._cameras:
            self._cameras[view.name] = view.camera.to(self.device)
        return self._cameras[view.name]
