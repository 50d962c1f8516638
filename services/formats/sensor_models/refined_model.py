"""Files with the refined model of a registered scene, in the format of the delivered model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amers.services.formats.images.ortho import write_refined_ortho
from amers.services.formats.images.tiled_image import TiledImage
from amers.services.formats.sensor_models.attitude_csv import ATTITUDE_CSV, format_attitude
from amers.services.formats.sensor_models.correction_json import OF_RIGOROUS, format_correction
from amers.services.formats.sensor_models.product_image import open_image
from amers.services.formats.sensor_models.rpc_files import (
    DeliveredModel,
    ImageFiles,
    has_rpc,
    model_of_image,
    read_rpc,
    write_model,
)
from amers.services.map_grid import MapGrid
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.moving_pushbroom import AttitudeMotion
from amers.services.sensors.ortho import OrthoModel, fold_into_ortho
from amers.services.sensors.refined import CARRIED_PX, LOUD_PX, REFIT_LIMIT_PX, RefinedRpc, refined_rpc
from amers.services.sensors.rpc import RpcModel
from amers.services.types import UNKNOWN_FRAME, Array, Frame

CORRECTION_JSON = "correction.json"
FIT_LIMIT_PX = 0.1
"""An RPC that misses its adjusted rigorous model by more is written with a warning."""
_LEAST_PX = 0.001
"""What a fit leaves below this is arithmetic."""


@dataclass(frozen=True)
class AdjustedRigorous:
    """An adjusted rigorous model, with what its files state of it.

    Attributes:
        model: adjusted.
        heights_m: lowest and highest ground of the scene, over which an RPC is fitted.
        correction_error_px: largest distance of the nearest correction from the adjusted model.
        rpc: fitted to the adjusted model.
        attitude: how the satellite turns beyond the parameters; None where it does not.
    """

    model: SensorModel
    heights_m: tuple[float, float]
    correction_error_px: float
    rpc: RefinedRpc
    attitude: AttitudeMotion | None = None


@dataclass(frozen=True)
class RefinedFiles:
    """The files written for a refined model.

    Attributes:
        files: `correction.json` first, then the files that contain the corrected model; none of these
            when no RPC is close enough to it.
        max_error_px: largest difference between the corrected model and the model in the files; 0 when
            they contain it exactly.
        note: one sentence on the files with the corrected model, and their accuracy.
    """

    files: tuple[Path, ...]
    max_error_px: float
    note: str


@dataclass(frozen=True)
class Stated:
    """What is stated of a correction beside its covariance.

    Attributes:
        frame: of the control points, for the errors of the model on the Earth.
        held: rings of the area of the image for which accuracy is stated, see `format_correction`.
        ce90_px: of the worst place there. An RPC that misses a displacement along lines and samples by
            more is not written: it would be taken for what the verdict speaks of.
    """

    frame: Frame = UNKNOWN_FRAME
    held: Sequence[Array] | None = None
    ce90_px: float = math.inf


def write_refined(
    source: ImageFiles,
    model: SensorModel | AdjustedRigorous,
    adjustment: SceneAdjustment,
    *,
    shape: tuple[int, int],
    folder: Path,
    copy_image: bool = False,
    stated: Stated = Stated(),
) -> RefinedFiles:
    """Write the refined model of a scene.

    | model of the scene | written |
    |---|---|
    | RPC of any source | `refined_RPC.TXT` |
    | RPC tags, NITF | `STEM_RPC.TXT`, which GDAL prefers to the tags of the image beside it |
    | `_RPC.TXT`, RPB, DIMAP, `.geom` | the file under its own name |
    | map grid | `IMAGE.aux.xml`, which GDAL prefers to the map grid of the image beside it |
    | adjusted rigorous model | as for an RPC, the one fitted to it; the note states its error |
    | the same, of a satellite that turns beyond the parameters | also `attitude.csv` |
    | any of a GeoTIFF | a copy of the image with new tags, when `copy_image` |

    An RPC that differs from the model with an affine correction by 0.01 px or more is not written, nor
    one that misses a displacement or an attitude by more than is stated: `correction.json` then applies
    to the delivered model.

    Args:
        source: the files that the scene was read from.
        model: the delivered model with its correction, or an adjusted rigorous model.
        adjustment: order and covariance of the correction; for a rigorous model of the nearest one.
        shape: lines and samples of the image.
        folder: where to write; created when missing.
        copy_image: also write a copy of a GeoTIFF with the refined model in its tags.
        stated: of the correction beside its covariance.

    Raises:
        FormatError: a delivered file would be overwritten.
    """
    folder.mkdir(parents=True, exist_ok=True)
    image_path = source.image
    copied = image_path if copy_image and _is_geotiff(image_path) else None
    if copied is not None and (folder / copied.name).resolve() != copied.resolve():
        (folder / copied.name).unlink(missing_ok=True)
    model_files, applies_to = _write_model(
        source, model, shape, folder, copied=copied, stated_px=stated.ce90_px
    )
    accuracy = CorrectionAccuracy(
        adjustment.correction,
        adjustment.covariance,
        adjustment.local_sigma_px,
        stated.frame,
        adjustment.apart_px,
    )
    text = format_correction(
        accuracy, adjustment.order, applies_to=applies_to, carried=model_files.note, held=stated.held
    )
    (folder / CORRECTION_JSON).write_text(text, encoding="utf-8")
    files = [folder / CORRECTION_JSON, *model_files.files]
    if isinstance(model, AdjustedRigorous) and model.attitude:
        files.append(folder / ATTITUDE_CSV)
        files[-1].write_text(format_attitude(model.attitude), encoding="utf-8")
    return RefinedFiles(tuple(files), model_files.max_error_px, model_files.note)


def _write_model(
    source: ImageFiles,
    model: SensorModel | AdjustedRigorous,
    shape: tuple[int, int],
    folder: Path,
    *,
    copied: Path | None,
    stated_px: float,
) -> tuple[RefinedFiles, str]:
    """The files of a refined model, and what a correction beside them applies to."""
    image_path = source.image
    base = model.base if isinstance(model, CorrectedModel) else None
    if isinstance(model, AdjustedRigorous):
        delivered = _delivered_rpc(*source)
        model_files = _write_fitted(delivered, model, folder, copied, stated_px=stated_px)
        applies_to = (
            f"{OF_RIGOROUS} of {image_path.name}: the nearest correction to the adjusted one, "
            f"{model.correction_error_px:.2g} px off it at most"
        )
    elif isinstance(model, CorrectedModel) and isinstance(base, OrthoModel):
        grid = fold_into_ortho(base, model.correction).grid
        model_files = _write_grid(image_path, grid, folder, copied is not None)
        applies_to = f"map grid of {image_path.name}"
    else:
        delivered = read_rpc(*source) if isinstance(base, RpcModel) else None
        model_files = _write_rpc(delivered, model, shape, folder, copied, stated_px=stated_px)
        applies_to = delivered.note if delivered else f"model of {image_path.name}"
    return model_files, applies_to


def _write_rpc(
    delivered: DeliveredModel | None,
    model: SensorModel,
    shape: tuple[int, int],
    folder: Path,
    copied: Path | None,
    *,
    stated_px: float,
) -> RefinedFiles:
    refined = refined_rpc(model, shape)
    if refined.max_error_px > max(stated_px, LOUD_PX):
        note = (
            f"no refined RPC is written: the nearest is up to {refined.max_error_px:.2g} px off, more "
            f"than the CE90 of {stated_px:.2g} px that is stated relative to the control points; no RPC "
            f"follows lines and samples so. Use the image that "
            f"`amers scene straighten` makes, or {CORRECTION_JSON} with the delivered model"
        )
        return RefinedFiles((), refined.max_error_px, note)
    if refined.model is None:
        note = (
            f"no RPC is within {REFIT_LIMIT_PX:g} px of the corrected model (the nearest differs by "
            f"{refined.max_error_px:.3g} px): {CORRECTION_JSON} applies to the delivered model"
        )
        return RefinedFiles((), refined.max_error_px, note)
    files = write_model(delivered, refined.model, folder, copied)
    names = ", ".join(file.name for file in files)
    exact = refined.max_error_px == 0.0
    how = "exactly" if exact else f"fitted within {max(refined.max_error_px, _LEAST_PX):.2g} px"
    if refined.max_error_px > LOUD_PX:
        how = (
            f"up to {refined.max_error_px:.2g} px OFF: no RPC follows lines and samples so. Use "
            "the image that `amers scene straighten` makes, or "
            f"{CORRECTION_JSON} with the delivered model"
        )
    return RefinedFiles(tuple(files), refined.max_error_px, f"{names}: the corrected model, {how}")


def _write_fitted(
    delivered: DeliveredModel | None,
    adjusted: AdjustedRigorous,
    folder: Path,
    copied: Path | None,
    *,
    stated_px: float,
) -> RefinedFiles:
    """The RPC fitted to an adjusted rigorous model, also in the format of a delivered RPC."""
    refined = adjusted.rpc
    low, high = adjusted.heights_m
    instead = f"{CORRECTION_JSON} with the delivered rigorous model"
    if adjusted.attitude:
        instead += f", or its parameters as found and {ATTITUDE_CSV}"
    if refined.model is None:
        note = f"no RPC could be fitted to the adjusted rigorous model at {low:.0f} to {high:.0f} m"
        return RefinedFiles((), refined.max_error_px, note)
    if refined.max_error_px > max(stated_px, CARRIED_PX):
        note = (
            f"no refined RPC is written: the nearest is up to {refined.max_error_px:.2g} px off the "
            f"adjusted rigorous model, more than the CE90 of {stated_px:.2g} px that is stated relative "
            f"to the control points; no RPC follows this attitude. Use {instead}"
        )
        return RefinedFiles((), refined.max_error_px, note)
    files = write_model(delivered, refined.model, folder, copied)
    names, off_px = ", ".join(file.name for file in files), refined.max_error_px
    note = (
        f"{names}: an RPC fitted to the adjusted rigorous model within {off_px:.2g} px, for ground at "
        f"{low:.0f} to {high:.0f} m"
    )
    if off_px > FIT_LIMIT_PX:
        note = f"WARNING: more than {FIT_LIMIT_PX:g} px off: {note}; no RPC follows this attitude closer"
        if adjusted.attitude:
            note += f". Use {instead}"
    return RefinedFiles(tuple(files), off_px, note)


def _delivered_rpc(
    image_path: Path, model_path: Path | None, crop_origin: tuple[float, float] | None
) -> DeliveredModel | None:
    """The RPC that was delivered beside a rigorous model; None without one."""
    image = open_image(image_path)
    try:
        if model_path is None and not has_rpc(image):
            return None
        return model_of_image(image, model_path, crop_origin)
    finally:
        image.close()


def _write_grid(image_path: Path, grid: MapGrid, folder: Path, copied: bool) -> RefinedFiles:
    files = write_refined_ortho(image_path, grid, folder, copied)
    names = ", ".join(file.name for file in files)
    return RefinedFiles(tuple(files), 0.0, f"{names}: the corrected map grid, exactly")


def _is_geotiff(path: Path) -> bool:
    image = open_image(path)
    image.close()
    return bool(image.dataset.driver == "GTiff") and not isinstance(image, TiledImage)
