"""Layers for the map: the points of a service, and the results of a registration."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from osgeo import gdal
from qgis.core import (
    QgsDataSourceUri,
    QgsMapLayer,
    QgsRasterLayer,
    QgsVectorLayer,
)

from .service import Service, ServiceError

POINTS_STYLE = Path(__file__).with_name("points.qml")
COEFFICIENTS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")


def points_layer(service: Service) -> QgsVectorLayer:
    """The points of a service, requested for the visible part of the map.

    Raises:
        ServiceError: the service does not answer, or refuses the token.
    """
    uri = QgsDataSourceUri()
    for name, value in (("url", service.url), ("typename", "points"), ("restrictToRequestBBOX", "1")):
        uri.setParam(name, value)
    uri.setAuthConfigId(service.authcfg)
    layer = QgsVectorLayer(uri.uri(False), "Amers points", "OAPIF")
    if not layer.isValid():
        reason = layer.dataProvider().error().summary() if layer.dataProvider() else ""
        raise ServiceError(reason or f"{service.url} has no points for this token")
    layer.loadNamedStyle(str(POINTS_STYLE))
    return layer


def registration_layers(image: Path, folder: Path) -> list[QgsMapLayer]:
    """The results of a registration, the lowest layer first: image, held area, residuals, points.

    The styles of the vectors are those in their file. There is no image on the map where the
    registration has no RPC.

    Args:
        image: that was registered.
        folder: of the results.

    Raises:
        ServiceError: a file cannot be opened.
    """
    points = _vector_layer(folder, "control_points")
    residuals = _vector_layer(folder, "residuals")
    layers: list[QgsMapLayer] = [residuals, points]
    held = QgsVectorLayer(f"{folder / 'residuals.gpkg'}|layername=held_area", "held area", "ogr")
    if held.isValid():
        # Services before 0.1 state no area.
        layers.insert(0, held)
    if (folder / "refined_RPC.TXT").exists():
        heights = (feature["height_m"] for feature in points.getFeatures("\"status\" = 'active'"))
        layers.insert(0, _image_on_map(image, folder, fmean(heights)))
    return layers


def _vector_layer(folder: Path, name: str) -> QgsVectorLayer:
    layer = QgsVectorLayer(
        f"{folder / 'residuals.gpkg'}|layername={name}", name.replace("_", " "), "ogr"
    )
    if not layer.isValid():
        raise ServiceError(f"{folder / 'residuals.gpkg'} has no layer {name}")
    return layer


def _image_on_map(image: Path, folder: Path, height_m: float) -> QgsRasterLayer:
    """The image on the map through its refined RPC, warped by GDAL as it is drawn.

    Args:
        image: that was registered.
        folder: of the results; receives two VRT files.
        height_m: of the ground above the ellipsoid.
    """
    with_model = gdal.Translate(str(folder / "with_model.vrt"), str(image), format="VRT")
    if with_model is None:
        raise ServiceError(f"{image} cannot be opened")
    with_model.SetMetadata(_rpc_metadata(folder / "refined_RPC.TXT"), "RPC")
    with_model.FlushCache()
    on_map = gdal.Warp(
        str(folder / "on_map.vrt"),
        with_model,
        format="VRT",
        rpc=True,
        dstSRS="EPSG:4326",
        dstNodata=0,
        transformerOptions=[f"RPC_HEIGHT={height_m}"],
    )
    if on_map is None:
        raise ServiceError(f"{image} has no place on the map by its refined RPC")
    on_map.FlushCache()
    return QgsRasterLayer(str(folder / "on_map.vrt"), f"{image.stem} at {height_m:.0f} m", "gdal")


def _rpc_metadata(path: Path) -> dict[str, str]:
    """An RPC file as GDAL keeps it: numbers by name, the coefficients of a polynomial in one line."""
    lines = (line.partition(":") for line in path.read_text().splitlines())
    values = {name.strip(): value.split()[0] for name, _, value in lines if value.split()}
    for name in COEFFICIENTS:
        values[name] = " ".join(values.pop(f"{name}_{term}") for term in range(1, 21))
    return values
