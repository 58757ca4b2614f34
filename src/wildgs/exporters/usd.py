"""OpenUSD files: one ParticleField3DGaussianSplat with the lights as a variant set."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wildgs.errors import UserError
from wildgs.exporters.lights import ExportLight, RelightableScene, thumbnail_url
from wildgs.exporters.splats import Splats
from wildgs.files import printable, written_aside
from wildgs.version import __version__

VARIANT_SET = "light"
ROOT, PRIM = "/Scene", "/Scene/Splats"

_SIGMAS = 3.0
"""Half extent of a Gaussian for the bounding box, in standard deviations."""


def write_usd(file: Path, scene: RelightableScene) -> None:
    """Writes a scene with its lights; needs usd-core 26.3 or newer.

    Geometry is written once. Each variant of `/Scene` has its own harmonics, name, time and thumbnail. The frame is
    +y up. The unit is declared as metres, since the scale of photos is unknown.

    Raises:
        UserError: usd-core is missing or too old, or the file cannot be written.
    """
    pxr = _modules()
    with written_aside(file) as aside:
        named = aside.with_name(aside.name + ".usd")  # USD chooses the format by the extension
        try:
            stage = pxr.Usd.Stage.CreateNew(str(named))
            _author(pxr, stage, scene)
            stage.GetRootLayer().Save()
            del stage
            named.replace(aside)
        except pxr.Tf.ErrorException as error:
            raise UserError(f"{file}: cannot be written: {str(error).splitlines()[0]}") from error
        finally:
            named.unlink(missing_ok=True)


def _modules() -> Any:
    """The modules of usd-core, imported dynamically because they have no type information."""
    try:
        names = ("Gf", "Tf", "Usd", "UsdGeom", "UsdVol", "Vt")
        pxr = SimpleNamespace(**{name: importlib.import_module(f"pxr.{name}") for name in names})
        pxr.UsdVol.ParticleField3DGaussianSplat  # noqa: B018
    except (ImportError, AttributeError) as error:
        raise UserError(
            ".usd files need usd-core 26.3 or newer; install it with `pip install 'wildgs[usd]'`"
        ) from error
    return pxr


def _author(pxr: Any, stage: Any, scene: RelightableScene) -> None:
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetMetadata("documentation", f"Wild-GS {__version__}")
    root = pxr.UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    root.SetCustomDataByKey("title", printable(scene.title))
    root.SetCustomDataByKey("to_colmap", _plain(pxr, scene.placement.to_dict()))
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    _author_geometry(pxr, field, scene.splats)
    variants = root.GetVariantSets().AddVariantSet(VARIANT_SET)
    names = variant_names(pxr, [light.name for light in scene.lights])
    for name, light in zip(names, scene.lights, strict=True):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            _author_light(pxr, root, field, light)
    variants.SetVariantSelection(names[0])


def variant_names(pxr: Any, names: list[str]) -> list[str]:
    """Converts names of photos to unique USD identifiers."""
    found: list[str] = []
    for name in names:
        valid, number = pxr.Tf.MakeValidIdentifier(printable(Path(name).stem)), 2
        free = valid
        while free in found:
            free, number = f"{valid}_{number}", number + 1
        found.append(free)
    return found


def _author_geometry(pxr: Any, field: Any, splats: Splats) -> None:
    means = splats.means.float()
    quats = (
        torch.nn.functional.normalize(splats.quats, dim=1).float().roll(-1, dims=1)
    )  # Vt stores x, y, z, w
    reach = _SIGMAS * splats.scales.float().max(dim=1, keepdim=True).values
    extent = torch.stack([(means - reach).min(dim=0).values, (means + reach).max(dim=0).values])
    field.CreatePositionsAttr(pxr.Vt.Vec3fArrayFromBuffer(_rows(means)))
    field.CreateOrientationsAttr(pxr.Vt.QuatfArrayFromBuffer(_rows(quats)))
    field.CreateScalesAttr(pxr.Vt.Vec3fArrayFromBuffer(_rows(splats.scales)))
    field.CreateOpacitiesAttr(pxr.Vt.FloatArrayFromBuffer(_rows(splats.opacities.clamp(0, 1))))
    field.CreateExtentAttr(pxr.Vt.Vec3fArrayFromBuffer(_rows(extent)))


def _author_light(pxr: Any, root: Any, field: Any, light: ExportLight) -> None:
    degree = round(light.sh.shape[1] ** 0.5) - 1
    field.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    coefficients = pxr.Vt.Vec3fArrayFromBuffer(_rows(light.sh.reshape(-1, 3)))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
    root.SetCustomDataByKey("photo", printable(light.name))
    root.SetCustomDataByKey("thumbnail", thumbnail_url(light.thumbnail))
    if light.captured is not None:
        root.SetCustomDataByKey("captured", light.captured)


def _rows(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().float().numpy())


def _plain(pxr: Any, numbers: dict[str, Any]) -> dict[str, Any]:
    """Converts a similarity transform to types of USD dictionaries."""
    return {
        "rotation": pxr.Gf.Matrix3d(*[value for row in numbers["rotation"] for value in row]),
        "translation": pxr.Gf.Vec3d(*numbers["translation"]),
        "scale": float(numbers["scale"]),
    }
