"""Methods by name: how each starts from points, and how each comes back from a checkpoint."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.errors import UserError
from wildgs.model.config import MethodName
from wildgs.model.encoder import encoder_of
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method
from wildgs.model.triplane import Box
from wildgs.model.vanilla import VanillaGS
from wildgs.model.wildgs import ColoredPoints, WildGS, WildGSConfig

_ROWS = "gaussians.rows."


def create_method(
    name: MethodName,
    config: WildGSConfig,
    points: Float[Tensor, "P 3"],
    colors: UInt8[Tensor, "P 3"],
    dense: ColoredPoints | None = None,
    ground: ColoredPoints | None = None,
) -> Method:
    """A method at its start.

    Args:
        name: Which method.
        config: Used by `wildgs` alone.
        points: Sparse SfM points in the scene's aligned frame.
        colors: Their colours.
        dense: Further points with colours that `wildgs` alone starts from.
        ground: Where the ground goes on, likewise.
    """
    if name == "3dgs":
        return VanillaGS.from_points(points, colors)
    return WildGS.from_points(config, points, colors, dense=dense, ground=ground)


def restore_method(name: MethodName, config: WildGSConfig, state: dict[str, Tensor]) -> Method:
    """A method as `Method.state_dict` described it; reads no pretrained weights.

    Raises:
        UserError: The tensors do not belong to this method and configuration.
    """
    try:
        rows = {key.removeprefix(_ROWS): value for key, value in state.items() if key.startswith(_ROWS)}
        _check_rows(rows, name, config)
        gaussians = Gaussians(rows)
        if name == "3dgs":
            method: Method = VanillaGS(gaussians)
        else:
            box = Box(torch.zeros(3), torch.ones(3))
            encoder = encoder_of(state, "parsing.encoder.")
            method = WildGS(config, gaussians, box, encoder)
        method.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise UserError(f"the checkpoint does not fit method {name} as configured: {first}") from error
    return method


def _check_rows(rows: dict[str, Tensor], name: MethodName, config: WildGSConfig) -> None:
    """Whether all rows are there, each with its width and all with one length.

    Raises:
        KeyError: A row is missing.
        RuntimeError: A row has another shape.
    """
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "opacity_logits": (),
    }
    if name == "3dgs":
        shapes |= {"sh0": (1, 3), "shN": ((VanillaGS.sh_degree + 1) ** 2 - 1, 3)}
    else:
        shapes["intrinsic"] = (config.fusion.intrinsic_size,)
    count = rows["means"].shape[0]
    for row, shape in shapes.items():
        if rows[row].shape != (count, *shape):
            raise RuntimeError(f"{row} is {tuple(rows[row].shape)} where {(count, *shape)} is needed")
