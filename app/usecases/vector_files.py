"""Files of vectors that commands and jobs read and write, and what they refuse."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from amers.app.errors import InputError
from amers.services.formats.vector.layers import VectorLayer, driver_of, write_layer
from amers.services.formats.vector.pixel_coordinates import PixelOrigin
from amers.services.imagery.scene import Scene, scene_centre, scene_footprint
from amers.services.map_grid import utm_of
from amers.services.types import Array, BoolArray, IntArray
from amers.services.vectors.shapes import Shapes

Column = npt.NDArray[Any]


@dataclass(frozen=True)
class VectorFile:
    """Vectors in a file.

    Attributes:
        path: GeoPackage, GeoJSON, shapefile or FlatGeobuf.
        layer: its name; None for the only one.
    """

    path: Path
    layer: str | None = None


@dataclass(frozen=True)
class VectorOptions:
    """How vectors pass between a raw image and the map.

    Attributes:
        pixels: origin and signs of the pixel coordinates, see `line_sample_of_xy`.
        tolerance_px: add vertices where a transformed edge bends by more than this, pixels.
        skip_missed: leave out features whose lines of sight do not meet the terrain; without this
            option, they are an error.
    """

    pixels: PixelOrigin = "qgis"
    tolerance_px: float = 0.5
    skip_missed: bool = False


@dataclass(frozen=True)
class CorrectionOptions(VectorOptions):
    """How vectors of a raw image come onto the map.

    Attributes:
        margin_px: largest distance of a vertex outside the image, pixels.
        sigma_px: precision of the digitised vertices, one sigma, pixels.
        height_sigma_m: accuracy of the heights, one sigma, metres; by default the sigma of each cell of
            a surface, otherwise 0.1 of the posting.
    """

    margin_px: float = 5.0
    sigma_px: float = 0.5
    height_sigma_m: float | None = None


@dataclass(frozen=True)
class ProjectionOptions(VectorOptions):
    """How vectors of the map come into a raw image.

    Attributes:
        clip: cut features at the border of the image.
    """

    clip: bool = False


def check_options(options: VectorOptions) -> None:
    """Refuse options that no correction and no projection can have.

    Raises:
        InputError: one is negative, or the tolerance is 0; the message names it.
    """
    if not options.tolerance_px > 0.0:
        raise InputError(f"tolerance_px: {options.tolerance_px:g} found, more than 0 px expected")
    for name in ("margin_px", "sigma_px", "height_sigma_m"):
        value = getattr(options, name, None)
        if value is not None and not value >= 0.0:
            raise InputError(f"{name}: {value:g} found, 0 or more expected")


def write_vertices(
    path: Path, shapes: Shapes, entries: IntArray, columns: Mapping[str, Column], crs: str | None
) -> None:
    """Write the vertices of some entries of shapes as points, with the numbers of their features."""
    numbers = {"feature": shapes.geometry_of[entries] + 1, "vertex": shapes.vertex_of[entries]}
    table = pa.table(
        {name: pa.array(one, from_pandas=True) for name, one in {**numbers, **columns}.items()}
    )
    points = shapely.points(shapes.vertices[shapes.index[entries]])
    write_layer(path, VectorLayer("vertices", points, table, crs))


def refuse_overwriting(source: Path, output: Path, vertices: Path | None) -> None:
    """Refuse outputs of unknown formats, and such that would replace the input or each other.

    Raises:
        InputError: there is one.
    """
    driver_of(output)
    paths = [source.resolve(), output.resolve()]
    if vertices is not None:
        driver_of(vertices)
        paths.append(vertices.resolve())
    if len(set(paths)) < len(paths):
        raise InputError(f"{output}: inputs and outputs are one file; choose another name")


def refuse_longitudes(xy: Array, scene: Scene) -> None:
    """Refuse vertices (v, 2) that lie on the ground of the scene by longitude and latitude.

    Raises:
        InputError: all of them do.
    """
    footprint = scene_footprint(scene)
    if not len(xy):
        return
    longitude = xy[:, 0] + 360.0 * np.round((footprint[:, 0].mean() - xy[:, 0]) / 360.0)
    inside = shapely.contains_xy(shapely.Polygon(footprint), longitude, xy[:, 1])
    if inside.all():
        raise InputError(
            "all vertices have longitudes and latitudes of the scene's ground: they are georeferenced, "
            "pixel coordinates are expected. QGIS georeferences images by their RPC: draw on a view "
            "without it (`amers vectors canvas`); vectors of the map need `amers vectors project`"
        )


def refuse_missed(missed: BoolArray, place: str, options: VectorOptions) -> None:
    """Refuse features (n,) with places that meet no ground, unless the options leave them out.

    Raises:
        InputError: there are some; the message names the first place.
    """
    if missed.any() and not options.skip_missed:
        raise InputError(
            f"{place}: no ground found there; {int(missed.sum())} of {len(missed)} features have such "
            "places. Give a terrain that covers them, fill its voids (--fill-px), or leave these "
            "features out (--skip-missed)"
        )


def default_crs(output: Path, scene: Scene) -> str:
    """Code of the default reference system of a map: EPSG:4326 in GeoJSON, else the UTM zone."""
    if driver_of(output) == "GeoJSON":
        return "EPSG:4326"
    lon, lat, _ = scene_centre(scene)
    return utm_of(float(lon), float(lat))
