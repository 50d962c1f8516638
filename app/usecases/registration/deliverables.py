"""What a registration leaves in a folder: report, control points, refined model."""

import math
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from services.formats.gcp.json_formats import format_measures, format_opf, measure_status
from services.formats.gcp.marked_points import marked_points
from services.formats.gcp.odm import format_gcp_list
from services.formats.gcp.pci import format_pci_text
from services.formats.gcp.text_formats import format_asp_gcp, format_envi_pts, format_qgis_points
from services.formats.sensor_models.refined_model import write_refined
from services.formats.vector.residual_layers import exaggeration_for, write_residual_layers
from services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from services.imagery.source import reduce_image, render_chip
from services.registration.on_points import Registration, RegistrationOptions
from services.reports.document import format_report
from services.reports.html import format_html
from services.reports.report import RegistrationReport, build_report
from services.reports.summary import BlockUsed, Check, ChipPair, Method, Quicklook, RegistrationSummary
from services.sensors.ortho import OrthoModel
from services.types import Array, ChipSource, ControlPoints, Measures, point_chips

QUICKLOOK_PX = 1200
GALLERY_EACH = 6
"""Chips shown of the best, of the middle and of the worst scores."""

OUTPUTS = {
    "report.json": "The report as a document.",
    "report.html": "The report as a page.",
    "control_points.geojson": "What happened to each control point.",
    "control_points.gcp": "The active control points for the Ames Stereo Pipeline.",
    "control_points.points": "The control points for the georeferencer of QGIS.",
    "control_points.pts": "The active control points for ENVI.",
    "control_points_pci.txt": "The control points as a text file for the OrthoEngine of PCI.",
    "control_points_opf.json": "The active control points as OPF 1.0.",
    "gcp_list.txt": "The active control points for OpenDroneMap.",
    "residuals.gpkg": "Residual vectors and control points as layers of a GeoPackage.",
    "correction.json": "The correction found, whatever the model of the scene.",
    "refined_RPC.TXT": "The refined model as RPC text, in the pixels of the image, unless none fits.",
}
"""What a registration makes; the refined model in the convention of the input comes on top."""

MEDIA_TYPES = {
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".gcp": "text/plain",
    ".points": "text/plain",
    ".pts": "text/plain",
    ".gpkg": "application/geopackage+sqlite3",
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
    copy_image: bool = False,
    method: Method = "control points",
    checks: tuple[Check, ...] = (),
) -> tuple[RegistrationReport, dict[str, Path]]:
    """Write everything a user takes home from a registration.

    Args:
        folder: made when missing; files of the same names are replaced.
        image, model: the files of the scene, to write the refined model as they have it.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
        method: what the scene was registered on.
        checks: of the model against independent points.

    Returns:
        The report, and the files by name.
    """
    refined = write_refined(
        image,
        model,
        registration.model,
        registration.adjustment,
        shape=scene.image.shape,
        folder=folder,
        copy_image=copy_image,
    )
    summary = RegistrationSummary(
        scene=image.stem,
        acquisition=scene.acquisition,
        shape=scene.image.shape,
        gsd_m=scene_gsd_m(scene),
        model_kind="map grid" if isinstance(scene.model, OrthoModel) else "RPC",
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
        refit_error_px=refined.max_error_px,
        refined_note=refined.note,
        software_version=version("amers"),
        started_at=started_at,
        finished_at=datetime.now(UTC),
        method=method,
        checks=checks,
    )
    report = build_report(summary)
    sigma_m = _point_sigmas_m(points, registration.measures)
    texts = {
        "report.json": format_report(report),
        "report.html": format_html(report, summary),
        "control_points.geojson": format_measures(registration.measures, image.name, sigma_m),
        **_exchanged(registration.measures, image.name, sigma_m),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    layers = folder / "residuals.gpkg"
    exaggeration = exaggeration_for(registration.measures)
    write_residual_layers(layers, registration.measures, image.name, exaggeration)
    written = [*(folder / name for name in texts), layers, *refined.files]
    return report, {path.name: path for path in written}


def _exchanged(measures: Measures, image: str, sigma_m: Array) -> dict[str, str]:
    """The points that were found, in the formats of other tools."""
    found = np.flatnonzero(measures.matched)
    marks = marked_points(
        [str(point) for point in measures.point_id[found]],
        measures.lon_lat_h[found],
        measures.line_sample[found],
        sigma_m=sigma_m[found],
        image=[image] * len(found),
        sigma_px=measures.sigma_px[found],
        residual_px=measures.residual_px[found],
        active=measures.active[found],
    )
    return {
        "control_points.gcp": format_asp_gcp(marks),
        "control_points.points": format_qgis_points(marks),
        "control_points.pts": format_envi_pts(marks),
        "control_points_pci.txt": format_pci_text(marks),
        "control_points_opf.json": format_opf(marks),
        "gcp_list.txt": format_gcp_list(marks),
    }


def _point_sigmas_m(points: ControlPoints, measures: Measures) -> Array:
    """Sigmas (n, 3) of the points of the measures, east, north, up."""
    order = np.argsort(points.id)
    rows = order[np.searchsorted(points.id, measures.point_id, sorter=order)]
    return np.sqrt(np.diagonal(points.covariance_m2[rows], axis1=1, axis2=2))


def media_type(name: str) -> str:
    """The media type of an output."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), "application/octet-stream")


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
                status=measure_status(measures, i),
            )
        )
    return tuple(pairs)
