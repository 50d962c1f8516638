"""What a registration leaves in a folder: report, control points, refined model."""

import json
import math
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from services.formats.raster import DRIVER_OF_SIGNATURE
from services.formats.rpc_files import DeliveredModel, read_rpc, write_model
from services.imagery import reduce_image, render_chip
from services.registration import Registration, RegistrationOptions
from services.reports.document import format_report
from services.reports.html import format_html
from services.reports.report import (
    BlockUsed,
    ChipPair,
    Quicklook,
    RegistrationReport,
    RegistrationSummary,
    build_report,
)
from services.scene import Scene, scene_footprint, scene_gsd_m
from services.sensors.correction import CorrectedModel, fold_into_rpc
from services.sensors.rpc import RpcModel
from services.sensors.rpc_fit import fit_rpc
from services.types import ChipSource, ControlPoints, Measures, point_chips

QUICKLOOK_PX = 1200
GALLERY_EACH = 6
"""Chips shown of the best, of the middle and of the worst scores."""

OUTPUTS = {
    "report.json": "The report as a document.",
    "report.html": "The report as a page.",
    "control_points.geojson": "What happened to each control point.",
    "refined_RPC.TXT": "The refined model as RPC text, in the pixels of the image.",
}
"""What every registration makes; the refined model in the convention of the input comes on top."""

MEDIA_TYPES = {
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".html": "text/html",
    ".txt": "text/plain",
    ".rpb": "text/plain",
    ".xml": "application/xml",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
}


def write_outputs(
    folder: Path,
    image: Path,
    model: Path | None,
    scene: Scene,
    points: ControlPoints,
    chips: ChipSource,
    blocks: tuple[BlockUsed, ...],
    registration: Registration,
    options: RegistrationOptions,
    started_at: datetime,
) -> tuple[RegistrationReport, dict[str, Path]]:
    """Write everything a user takes home from a registration.

    Args:
        folder: made when missing; files of the same names are replaced.
        image, model: the files of the scene, to write the refined model as they have it.

    Returns:
        The report, and the files by name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    refined, refit_error_px = refined_rpc(registration.model, scene.image.shape)
    summary = RegistrationSummary(
        scene=image.stem,
        acquisition=scene.acquisition,
        shape=scene.image.shape,
        gsd_m=scene_gsd_m(scene),
        model_kind="RPC",
        sigma_m=scene.sigma_m,
        footprint=scene_footprint(scene),
        blocks=blocks,
        options=options,
        passes=registration.passes,
        order_reason=_order_reason(registration, options),
        measures=registration.measures,
        adjustment=registration.adjustment,
        qualification=registration.qualification,
        quicklook=_quicklook(scene),
        gallery=_gallery(scene, points, chips, registration),
        refit_error_px=refit_error_px,
        software_version=version("amers"),
        started_at=started_at,
        finished_at=datetime.now(UTC),
    )
    report = build_report(summary)
    texts = {
        "report.json": format_report(report),
        "report.html": format_html(report, summary),
        "control_points.geojson": format_measures(registration.measures),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    delivered = read_rpc(image, model)
    copied = image if _carries_tags(delivered, image) else None
    if copied is not None:
        (folder / image.name).unlink(missing_ok=True)
    models = write_model(delivered, refined, folder, copied)
    return report, {path.name: path for path in [*(folder / name for name in texts), *models]}


def refined_rpc(model: CorrectedModel, shape: tuple[int, int]) -> tuple[RpcModel, float]:
    """The RPC of a corrected model, and the largest difference of the two in pixels; NaN: none.

    A correction of each coordinate by itself folds into the delivered RPC exactly; one that mixes them
    is fitted anew over the range of heights of the delivered model.
    """
    base = model.base
    assert isinstance(base, RpcModel)
    if not model.correction.parameters[[0, 1], [2, 1]].any():
        return fold_into_rpc(base, model.correction), math.nan
    fitted = fit_rpc(model, shape, model.height_range_m)
    return fitted.model, fitted.max_error_px


def format_measures(measures: Measures) -> str:
    """GeoJSON of the points of a scene: where they are, where they were found, what became of them."""
    numbers = {
        "predicted_line": measures.predicted[:, 0],
        "predicted_sample": measures.predicted[:, 1],
        "line": measures.line_sample[:, 0],
        "sample": measures.line_sample[:, 1],
        "sigma_px": measures.sigma_px,
        "score": measures.score,
        "residual_line_px": measures.residual_px[:, 0],
        "residual_sample_px": measures.residual_px[:, 1],
        "residual_east_m": measures.residual_m[:, 0],
        "residual_north_m": measures.residual_m[:, 1],
    }
    features = [
        {
            "type": "Feature",
            "id": int(measures.point_id[i]),
            "geometry": {"type": "Point", "coordinates": [float(v) for v in lon_lat_h]},
            "properties": {
                "status": _status(measures, i),
                "reason": str(measures.reason[i]),
                "views": int(measures.views[i]),
                **{name: _finite(float(values[i])) for name, values in numbers.items()},
            },
        }
        for i, lon_lat_h in enumerate(measures.lon_lat_h)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def media_type(name: str) -> str:
    """The media type of an output."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), "application/octet-stream")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _status(measures: Measures, row: int) -> str:
    if measures.active[row]:
        return "active"
    return "deactivated" if measures.matched[row] else "not matched"


def _carries_tags(delivered: DeliveredModel, image: Path) -> bool:
    """Whether the model came in the tags of a GeoTIFF, and goes back into those of a copy."""
    with image.open("rb") as file:
        start = file.read(4)
    return delivered.convention == "tags" and DRIVER_OF_SIGNATURE.get(start) == "GTiff"


def _order_reason(registration: Registration, options: RegistrationOptions) -> str:
    """One sentence on why the correction has its order."""
    adjustment = registration.adjustment
    if options.adjustment.order is not None:
        return f"{adjustment.order}, as asked for"
    if len(adjustment.validation_px) == 1:
        return f"{adjustment.order}: the points are too few or too close together for more"
    scores = ", ".join(f"{order} {value_px:.2f} px" for order, value_px in adjustment.validation_px)
    return f"{adjustment.order}: residual of points left out of the fit: {scores}"


def _quicklook(scene: Scene) -> Quicklook:
    factor = max(1, math.ceil(max(scene.image.shape) / QUICKLOOK_PX))
    return Quicklook(reduce_image(scene.image, factor).pixels, float(factor))


def _gallery(
    scene: Scene, points: ControlPoints, chips: ChipSource, registration: Registration
) -> tuple[ChipPair, ...]:
    """Chips beside what the scene shows there: best, middle and worst of the scores."""
    measures = registration.measures
    scored = np.flatnonzero(np.isfinite(measures.score))
    ranked = scored[np.argsort(-measures.score[scored], kind="stable")]
    middle = max((len(ranked) - GALLERY_EACH) // 2, 0)
    shown = np.concatenate(
        [ranked[:GALLERY_EACH], ranked[middle:][:GALLERY_EACH], ranked[-GALLERY_EACH:]]
    )
    row_of_id = {int(point_id): row for row, point_id in enumerate(points.id)}
    pairs = []
    for i in dict.fromkeys(shown.tolist()):
        point_id = int(measures.point_id[i])
        row = row_of_id[point_id]
        gsd_m = float(points.views.gsd_m[points.views.start[row]])
        pairs.append(
            ChipPair(
                point_id=point_id,
                gsd_m=gsd_m,
                chip=point_chips(points, chips, row)[0],
                found=render_chip(scene.image, registration.model, measures.lon_lat_h[i], gsd_m),
                score=float(measures.score[i]),
                residual_px=measures.residual_px[i],
                status=_status(measures, i),
            )
        )
    return tuple(pairs)
