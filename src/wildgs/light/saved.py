"""Appearance files: looks of one run as small safetensors files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from wildgs.errors import UserError
from wildgs.files import is_there, written_aside
from wildgs.light.look import Look
from wildgs.model.appearance import Embeddings
from wildgs.model.method import Method
from wildgs.model.sky_profile import COLUMNS, with_palette

SUFFIX = ".safetensors"
FORMAT = "wildgs-appearance-2"
SKY = "sky."
"""Prefix of the tensors of the sky's look."""


def save_look(look: Look, file: Path) -> Path:
    """Writes a look, which `load_look` restores for the same checkpoint.

    Local embeddings are stored in half precision, and only those that differ from the most frequent one (they are
    all the same outside the triplane's box).

    Raises:
        UserError: The run cannot be relit, the extension is wrong, the file exists and is not an appearance, or it
            cannot be written.
    """
    if not look.method.relightable:
        raise UserError(f"{look.method.label} cannot be relit; there is no appearance to save")
    if file.suffix != SUFFIX:
        raise UserError(f"{file}: the name of an appearance file must end in {SUFFIX}")
    if is_there(file) and not _is_appearance(file):
        raise UserError(f"{file} exists and is not an appearance file; choose another name")
    tensors = _packed(look.embeddings)
    if look.sky is not None:
        tensors |= {f"{SKY}{name}": values for name, values in _packed(look.sky.embeddings).items()}
    header = {"format": FORMAT, "name": look.name, "run": look.method.fingerprint()}
    with written_aside(file) as aside:
        aside.write_bytes(save(tensors, metadata={"wildgs": json.dumps(header)}))
    return file


def _is_appearance(file: Path) -> bool:
    """Whether a file is an appearance, of any version and any run."""
    try:
        with safe_open(file, framework="pt") as opened:
            header = json.loads((opened.metadata() or {}).get("wildgs", "{}"))
        return str(header.get("format", "")).startswith(FORMAT.rstrip("0123456789"))
    except (OSError, ValueError, AttributeError, SafetensorError):
        return False


def load_look(method: Method, file: Path) -> Look:
    """Reads an appearance file of the same checkpoint.

    Raises:
        UserError: The file is missing, is not an appearance file, or belongs to another run or step.
    """
    if not file.is_file():
        raise UserError(
            f"{file}: no such file; `wildgs appearance RUN PHOTO --output {file.name}` creates it"
        )
    try:
        with safe_open(file, framework="pt") as opened:
            header = json.loads((opened.metadata() or {})["wildgs"])
            if header["format"] != FORMAT:
                raise KeyError("format")
            tensors = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
        name, owner = str(header["name"]), header["run"]
        if not method.relightable or owner != method.fingerprint():
            raise UserError(
                f"{file}: belongs to another run, or to another step of this run; create it again by "
                "`wildgs appearance`"
            )
        of_sky = {key.removeprefix(SKY): values for key, values in tensors.items() if key.startswith(SKY)}
        sky = Look(f"sky of {name}", _fitting(method, of_sky), method) if of_sky else None
        return Look(name, _fitting(method, tensors), method, sky=sky)
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{file}: not an appearance file; `wildgs appearance` writes them") from error


def _packed(embeddings: Embeddings) -> dict[str, Tensor]:
    """Converts embeddings to the file's tensors."""
    tensors = {"global_embedding": embeddings.global_embedding.detach().cpu().float().contiguous()}
    if embeddings.color_map is not None:
        tensors["color_map"] = embeddings.color_map.detach().cpu().contiguous()
    if embeddings.basis_weights is not None:
        tensors["basis_weights"] = embeddings.basis_weights.detach().cpu().contiguous()
    if embeddings.response is not None:
        tensors["response"] = embeddings.response.detach().cpu().contiguous()
    if embeddings.sky_profile is not None:
        tensors["sky_profile"] = embeddings.sky_profile.detach().cpu().contiguous()
    if embeddings.local_embeddings is None:
        return tensors
    local = embeddings.local_embeddings.detach().cpu()
    shared = local.mode(dim=0).values
    rows = (local != shared).any(dim=1).nonzero()[:, 0]
    return tensors | {
        "shared_local": shared.contiguous(),
        "rows": rows.to(torch.int32),
        "local_embeddings": local[rows].half().contiguous(),
    }


def _fitting(method: Method, tensors: Mapping[str, Tensor]) -> Embeddings:
    """Converts the file's tensors to embeddings; `KeyError` or `ValueError` if they do not fit the method."""
    device = method.gaussians.means.device
    common, color_map = tensors["global_embedding"], tensors.get("color_map")
    if common.shape != (method.global_size,):
        raise ValueError("embeddings of another length")
    if color_map is not None and color_map.shape == (3, 4) and not color_map.any():
        color_map = None  # written by earlier versions
    if color_map is not None and color_map.shape != (3, method.map_columns):
        raise ValueError("a colour map of another shape")
    weights = tensors.get("basis_weights")
    if weights is not None and weights.shape != (method.basis_size,):
        raise ValueError("basis weights of another length")
    response = tensors.get("response")
    if response is not None and response.shape != (method.response_size,):
        raise ValueError("a camera response of another length")
    sky_profile = tensors.get("sky_profile")
    if sky_profile is not None:
        sky_profile = with_palette(sky_profile)
    if sky_profile is not None and sky_profile.shape != (3, COLUMNS):
        raise ValueError("a sky profile of another shape")
    local = _local_embeddings(method, tensors) if method.local_size else None
    parts = (common, local, color_map, weights, response, sky_profile)
    if not all(bool(values.isfinite().all()) for values in parts if values is not None):
        raise ValueError("embeddings that are not finite")
    return Embeddings(*(None if values is None else values.float().to(device) for values in parts))  # type: ignore[arg-type]


def _local_embeddings(method: Method, tensors: Mapping[str, Tensor]) -> Tensor:
    count, length = len(method.gaussians), (method.local_size,)
    shared, rows = tensors["shared_local"].float(), tensors["rows"]
    inside = tensors["local_embeddings"].float()
    if shared.shape != length:
        raise ValueError("embeddings of another length")
    if rows.dtype != torch.int32 or rows.dim() != 1 or inside.shape != (len(rows), *length):
        raise ValueError("rows without embeddings")
    if bool(((rows < 0) | (rows >= count)).any()):
        raise ValueError("rows of no Gaussian")
    local = shared.repeat(count, 1)
    local[rows.long()] = inside
    return local
