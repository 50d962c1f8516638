"""The refined model of a registered scene: in the convention of its own, and always as a correction."""

from dataclasses import dataclass
from pathlib import Path

from services.adjustment.image_correction import SceneAdjustment
from services.formats.images.ortho import write_refined_ortho
from services.formats.images.raster import open_raster
from services.formats.sensor_models.correction_json import format_correction
from services.formats.sensor_models.rpc_files import DeliveredModel, read_rpc, write_model
from services.map_grid import MapGrid
from services.sensors.correction import CorrectedModel
from services.sensors.ortho import OrthoModel, fold_into_ortho
from services.sensors.refined import REFIT_LIMIT_PX, refined_rpc
from services.sensors.rpc import RpcModel

CORRECTION_NAME = "correction.json"


@dataclass(frozen=True)
class RefinedFiles:
    """What was written of a refined model.

    Attributes:
        files: `correction.json` first; then those that carry the correction, none when it was refused.
        max_error_px: largest difference between the corrected model and what the files say; 0 when they
            carry it exactly.
        note: one sentence on which files carry the correction, and how well.
    """

    files: tuple[Path, ...]
    max_error_px: float
    note: str


def write_refined(
    image_path: Path,
    model_path: Path | None,
    model: CorrectedModel,
    adjustment: SceneAdjustment,
    shape: tuple[int, int],
    folder: Path,
    copy_image: bool = False,
) -> RefinedFiles:
    """Write the refined model of a scene.

    | model of the scene | written |
    |---|---|
    | RPC of any source | `refined_RPC.TXT` |
    | RPC tags, NITF | `STEM_RPC.TXT`: laid beside the image, GDAL prefers it to the tags |
    | `_RPC.TXT`, RPB, DIMAP | the file under its own name |
    | map grid | `IMAGE.aux.xml`: laid beside the image, GDAL prefers it to the image's own |
    | any of a GeoTIFF | a copy of the image with new tags, only when asked for |

    An RPC that would miss the corrected model by 0.01 px or more is refused: `correction.json` then goes
    with the model as delivered.

    Args:
        image_path, model_path: the files of the scene.
        model: as delivered, with its correction.
        adjustment: the correction's order and covariance.
        shape: lines and samples of the image.
        folder: where to write; made when missing.
        copy_image: also copy a GeoTIFF, its new model in its tags.

    Raises:
        FormatError: when a file that was delivered would be written over.
    """
    folder.mkdir(parents=True, exist_ok=True)
    copied = image_path if copy_image and _is_geotiff(image_path) else None
    if copied is not None and (folder / copied.name).resolve() != copied.resolve():
        (folder / copied.name).unlink(missing_ok=True)
    if isinstance(model.base, OrthoModel):
        grid = fold_into_ortho(model.base, model.correction).grid
        found = _write_grid(image_path, grid, folder, copied is not None)
        applies_to = f"map grid of {image_path.name}"
    else:
        delivered = read_rpc(image_path, model_path) if isinstance(model.base, RpcModel) else None
        found = _write_rpc(delivered, model, shape, folder, copied)
        applies_to = delivered.note if delivered else f"model of {image_path.name}"
    text = format_correction(
        model.correction, adjustment.order, adjustment.covariance, applies_to, found.note
    )
    (folder / CORRECTION_NAME).write_text(text, encoding="utf-8")
    return RefinedFiles((folder / CORRECTION_NAME, *found.files), found.max_error_px, found.note)


def _write_rpc(
    delivered: DeliveredModel | None,
    model: CorrectedModel,
    shape: tuple[int, int],
    folder: Path,
    copied: Path | None,
) -> RefinedFiles:
    refined = refined_rpc(model, shape)
    if refined.model is None:
        note = (
            f"no RPC comes within {REFIT_LIMIT_PX:g} px of the corrected model, the nearest is "
            f"{refined.max_error_px:.3g} px away: {CORRECTION_NAME} goes with the model as delivered"
        )
        return RefinedFiles((), refined.max_error_px, note)
    files = write_model(delivered, refined.model, folder, copied)
    names = ", ".join(file.name for file in files)
    exact = refined.max_error_px == 0.0
    how = "exactly" if exact else f"fitted within {refined.max_error_px:.2g} px"
    return RefinedFiles(tuple(files), refined.max_error_px, f"{names}: the corrected model, {how}")


def _write_grid(image_path: Path, grid: MapGrid, folder: Path, copied: bool) -> RefinedFiles:
    files = write_refined_ortho(image_path, grid, folder, copied)
    names = ", ".join(file.name for file in files)
    return RefinedFiles(tuple(files), 0.0, f"{names}: the corrected map grid, exactly")


def _is_geotiff(path: Path) -> bool:
    image = open_raster(path)
    image.close()
    return bool(image.dataset.driver == "GTiff")
