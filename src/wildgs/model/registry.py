"""Methods by name: how each starts from points, and how each comes back from a checkpoint."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.errors import UserError
from wildgs.model.encoder import load_encoder
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method
from wildgs.model.triplane import Box
from wildgs.model.vanilla import VanillaGS
from wildgs.model.wildgs import WildGS, WildGSConfig

MethodName = Literal["wildgs", "3dgs"]
_ROWS = "gaussians.rows."


def create_method(
    name: MethodName,
    config: WildGSConfig,
    points: Float[Tensor, "P 3"],
    colors: UInt8[Tensor, "P 3"],
) -> Method:
    """A method at its start.

    Args:
        name: Which method.
        config: Used by `wildgs` alone.
        points: Sparse SfM points in the scene's aligned frame.
        colors: Their colours.
    """
    if name == "3dgs":
        return VanillaGS.from_points(points, colors)
    return WildGS.from_points(config, points, colors)


def restore_method(name: MethodName, config: WildGSConfig, state: dict[str, Tensor]) -> Method:
    """A method as `Method.state_dict` described it; reads no pretrained weights.

    Raises:
        UserError: The tensors do not belong to this method and configuration.
    """
    try:
        rows = {key.removeprefix(_ROWS): value for key, value in state.items() if key.startswith(_ROWS)}
        gaussians = Gaussians(rows)
        if name == "3dgs":
            method: Method = VanillaGS(gaussians)
        else:
            box = Box(torch.zeros(3), torch.ones(3))
            method = WildGS(config, gaussians, box, load_encoder(None))
        method.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise UserError(f"the checkpoint does not fit method {name} as configured: {first}") from error
    return method
