"""Appearance files: a look of one run, small and without code in it (safetensors)."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from wildgs.errors import UserError
from wildgs.light.look import Look
from wildgs.model.appearance import Embeddings
from wildgs.model.method import Method
from wildgs.model.wildgs import WildGS

SUFFIX = ".safetensors"
FORMAT = "wildgs-appearance-1"


def save_look(look: Look, file: Path) -> Path:
    """Writes a look so that `load_look` brings it back for the same checkpoint.

    The global embedding is kept as it is, the local ones in half precision, and only those that differ from the
    one that most Gaussians share (outside the triplane's box all are alike).

    Raises:
        UserError: The look is of a run that has one light only, or the name does not end as it must.
    """
    if look.embeddings is None:
        raise UserError("this run is plain 3dgs: it has one light, its own, and nothing to save")
    if file.suffix != SUFFIX:
        raise UserError(f"{file}: appearance files end in {SUFFIX}")
    local = look.embeddings.local_embeddings.detach().cpu()
    shared = local.mode(dim=0).values
    rows = (local != shared).any(dim=1).nonzero()[:, 0]
    tensors = {
        "global_embedding": look.embeddings.global_embedding.detach().cpu().float().contiguous(),
        "shared_local": shared.contiguous(),
        "rows": rows.to(torch.int32),
        "local_embeddings": local[rows].half().contiguous(),
    }
    header = {
        "format": FORMAT,
        "name": look.name,
        "gaussians": str(len(local)),
        "run": fingerprint(look.method),
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    aside = file.with_name(file.name + ".part")
    aside.write_bytes(save(tensors, metadata={"wildgs": json.dumps(header)}))
    aside.replace(file)
    return file


def load_look(method: Method, file: Path) -> Look:
    """Reads an appearance file for the checkpoint that it was made with.

    Raises:
        UserError: The file is missing or no appearance file, or belongs to another run or step.
    """
    if not file.is_file():
        raise UserError(f"{file}: no such file; `wildgs appearance RUN PHOTO --output {file.name}` makes one")
    try:
        with safe_open(file, framework="pt") as opened:
            header = json.loads((opened.metadata() or {})["wildgs"])
            if header["format"] != FORMAT:
                raise KeyError("format")
            tensors = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
        shared, rows = tensors["shared_local"], tensors["rows"].long()
        name, owner, count = str(header["name"]), header["run"], int(header["gaussians"])
        global_embedding, inside = tensors["global_embedding"], tensors["local_embeddings"]
        if len(rows) != len(inside) or bool(((rows < 0) | (rows >= count)).any()):
            raise ValueError("rows of no Gaussian")
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{file}: is no appearance file; `wildgs appearance` makes one") from error
    if not isinstance(method, WildGS) or owner != fingerprint(method):
        raise UserError(
            f"{file}: was made with another run, or another step of this one; make it anew with `wildgs appearance`"
        )
    local = shared.repeat(count, 1)
    local[rows] = inside.float()
    device = method.gaussians.means.device
    return Look(name, Embeddings(global_embedding.to(device), local.to(device)), method)


def fingerprint(method: Method) -> str:
    """What tells one trained state from another: a digest of the centres and the fusion network."""
    digest = hashlib.sha256()
    state = method.state_dict()
    for key in sorted(state):
        if key.startswith("fusion.") or key == "gaussians.rows.means":
            digest.update(key.encode())
            digest.update(state[key].detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]
