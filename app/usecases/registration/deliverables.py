"""The outputs of a registration: write its report and control points, in the formats of many tools."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from amers.app.usecases.report_files import write_report, write_texts
from amers.services.formats.gcp.json_formats import format_measures, format_opf
from amers.services.formats.gcp.marked_points import MarkedPoints, marked_points
from amers.services.formats.gcp.odm import format_gcp_list
from amers.services.formats.gcp.pci import format_pci_text
from amers.services.formats.gcp.text_formats import format_asp_gcp, format_envi_pts, format_qgis_points
from amers.services.formats.vector.residual_layers import exaggeration_for, write_residual_layers
from amers.services.reports.registration_pages import REGISTRATION_PAGE
from amers.services.reports.report import RegistrationReport
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, ControlPoints, IntArray, Measures

OUTPUTS = {
    "report.json": "The report as a document.",
    "report.html": "The report as a page.",
    "report.txt": "The tables of the report as plain text.",
    "control_points.geojson": "The measure of each control point, with its status.",
    "control_points.gcp": "The active control points for the Ames Stereo Pipeline.",
    "control_points.points": "The control points for the georeferencer of QGIS.",
    "control_points.pts": "The active control points for ENVI.",
    "control_points_pci.txt": "The control points as a text file for the OrthoEngine of PCI.",
    "control_points_opf.json": "The active control points as OPF 1.0.",
    "gcp_list.txt": "The active control points for OpenDroneMap.",
    "residuals.gpkg": "Residual vectors, control points and the held area as layers of a GeoPackage.",
    "correction.json": "The correction, for every kind of sensor model.",
    "refined_RPC.TXT": "The refined model as RPC text, in the pixels of the image, unless none fits.",
}
"""Outputs of a registration; the refined model in the format of the input comes in addition."""

TITLES = {**OUTPUTS, "attitude.csv": "Roll and pitch over time of a rigorous model whose lines move."}
"""What files of a registration are, alone or together with others."""


def write_outputs(
    folder: Path,
    report: RegistrationReport,
    image: str,
    points: ControlPoints,
    model: SensorModel,
) -> dict[str, Path]:
    """Write the report and the control points of a registration; returns the files by name.

    Args:
        folder: created when missing; files of the same names are replaced.
        report: of the registration.
        image: file name of the scene, which the control points refer to.
        points: the control points of the registration, for their precision and their surface.
        model: of the scene, refined.
    """
    measures = report.figure_data.measures
    sigma_m = _point_sigmas_m(points, measures)
    names = {} if report.marks is None else {mark.point: mark.name for mark in report.marks.marks}
    marks = _marks(measures, sigma_m, points, image, model, names=names)
    files = write_report(folder, REGISTRATION_PAGE, report)
    geojson = format_measures(measures, image, sigma_m)
    texts = {"control_points.geojson": geojson, **_exchange_formats(marks)}
    layers = folder / "residuals.gpkg"
    held = report.coverage.polygons_lon_lat
    write_residual_layers(layers, measures, image, exaggeration_for(measures), held)
    return {**files, **write_texts(folder, texts), layers.name: layers}


def _marks(
    measures: Measures,
    sigma_m: Array,
    points: ControlPoints,
    image: str,
    model: SensorModel,
    *,
    names: Mapping[int, str],
) -> MarkedPoints:
    """The matched points where the scene shows the surface at them, where it is known.

    Marks of a person keep their names.

    The height at which chips are found is that of their whole content. Other tools take a mark for a
    place on the ground: it gets the height of the surface, and moves in the image by the parallax
    between both heights, so that its residual stays.
    """
    matched = np.flatnonzero(measures.matched)
    lon_lat_h, line_sample = measures.lon_lat_h[matched], measures.line_sample[matched]
    sigma_m = sigma_m[matched]
    if points.surface is not None:
        rows = _rows(points, measures)[matched]
        height_m = points.surface.height_m[rows]
        known = np.isfinite(height_m)
        before = model.project(lon_lat_h[known])
        lon_lat_h[known, 2] = height_m[known]
        line_sample[known] += model.project(lon_lat_h[known]) - before
        sigma_m[known, 2] = points.surface.sigma_m[rows][known]
    return marked_points(
        [names.get(point, str(point)) for point in measures.point_id[matched].tolist()],
        lon_lat_h,
        line_sample,
        sigma_m=sigma_m,
        image=[image] * len(matched),
        sigma_px=measures.sigma_px[matched],
        residual_px=measures.residual_px[matched],
        active=measures.active[matched],
    )


def _exchange_formats(marks: MarkedPoints) -> dict[str, str]:
    """Marks in the formats of other tools, by file name."""
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
    return np.sqrt(np.diagonal(points.covariance_m2[_rows(points, measures)], axis1=1, axis2=2))


def _rows(points: ControlPoints, measures: Measures) -> IntArray:
    """Row (n,) of the point of each measure."""
    order = np.argsort(points.id)
    return np.asarray(order[np.searchsorted(points.id, measures.point_id, sorter=order)])
