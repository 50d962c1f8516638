"""Vectors between a raw scene and the map: for the command line, and as a process."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from amers.app.errors import InputError
from amers.app.usecases.registered_scene import SceneModel, read_raw_scene
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.app.usecases.vector_files import (
    CorrectionOptions,
    ProjectionOptions,
    VectorFile,
    check_options,
    default_crs,
    refuse_longitudes,
    refuse_missed,
    refuse_overwriting,
    write_vertices,
)
from amers.services.formats.vector.layers import VectorLayer, write_layer
from amers.services.formats.vector.map_layers import read_map_layer, read_pixel_layer
from amers.services.formats.vector.pixel_coordinates import (
    PixelOrigin,
    check_inside,
    line_sample_of_xy,
    xy_of_line_sample,
)
from amers.services.imagery.scene import Scene
from amers.services.map_grid import check_map, check_map_code
from amers.services.quality.accuracy_statement import StatedAccuracy, vertices_accuracy
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.statements import Statements, gathered
from amers.services.types import IntArray
from amers.services.vectors.accuracy import ErrorSources
from amers.services.vectors.correct import CorrectedVectors, correct_vectors, has_heights, missed_place
from amers.services.vectors.project import (
    ProjectedVectors,
    cut,
    ground_outline,
    hidden_share,
    image_outline,
    project_vectors,
)
from amers.services.vectors.shapes import Geometries, Shapes, geometries_of, shapes_of

RELATIVE_CE90, ON_THE_EARTH_CE90, HIDDEN = "ce90_m", "ce90_earth", "hidden"
"""Attributes that features get: the largest CE90 of their vertices, metres; share of hidden vertices."""


@dataclass(frozen=True)
class CorrectedFile:
    """Vectors of a raw scene that were written on the map.

    Attributes:
        path: of the file.
        crs: of its map.
        heights: vertical datum of its heights.
        features, vertices: that it has.
        added_vertices: of these, on edges that the ground bends.
        left_out: numbers of the features, from 1, with a place that meets no ground.
        unusable: numbers of the features whose geometry cannot be used, with the reason; left out too.
        renamed: attributes that have other names in the file, with these.
        height_sigma_m: of the terrain, as used; the median of its places.
        relative_to_control_points, on_the_earth: predicted accuracy of the vertices.
        statements: of the files of the scene, the terrain and the vectors.
    """

    path: Path
    crs: str
    heights: str
    features: int
    vertices: int
    added_vertices: int
    left_out: tuple[int, ...]
    height_sigma_m: float
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    unusable: dict[int, str]
    renamed: dict[str, str]
    statements: Statements = ()

    def __repr__(self) -> str:
        relative, on_the_earth = self.relative_to_control_points, self.on_the_earth
        return (
            f"CorrectedFile {self.path}: {self.crs}, {self.features} features with {self.vertices} "
            f"vertices\n  {relative.label}: {relative.words}\n  {on_the_earth.label}: "
            f"{on_the_earth.words}"
        )


@dataclass(frozen=True)
class ProjectedFile:
    """Vectors of the map that were written in the pixel coordinates of a raw scene.

    Attributes:
        path: of the file.
        pixels: origin and signs of its coordinates.
        features, vertices: that it has.
        added_vertices: on edges that are bent in the image.
        hidden_vertices: that other ground hides from the sensor.
        outside: features that the scene does not show.
        left_out: numbers of the features, from 1, with a place without a height of the ground.
        unusable, renamed, statements: as for `CorrectedFile`.
    """

    path: Path
    pixels: PixelOrigin
    features: int
    vertices: int
    added_vertices: int
    hidden_vertices: int
    outside: int
    left_out: tuple[int, ...]
    unusable: dict[int, str]
    renamed: dict[str, str]
    statements: Statements = ()


_CORRECTION = CorrectionOptions()
_PROJECTION = ProjectionOptions()


def correct_file(
    vectors: VectorFile,
    scene_model: SceneModel,
    terrain: TerrainFile,
    output: Path,
    *,
    crs: str | None = None,
    vertices: Path | None = None,
    options: CorrectionOptions = _CORRECTION,
) -> CorrectedFile:
    """Write vectors that were digitised on a raw scene, on the map.

    Args:
        vectors: in pixel coordinates of the scene; their reference system, if any, is ignored.
        scene_model: the scene and its model.
        terrain: the ground.
        output: file to write; an existing one is replaced.
        crs: code of the reference system of the map; by default the UTM zone of the scene, EPSG:4326 in
            GeoJSON.
        vertices: file to write with every vertex, its image position and its accuracy; None for none.
        options: of the correction.

    Raises:
        InputError: a file cannot be used, vertices lie outside the image, or places meet no ground.
    """
    check_options(options)
    refuse_overwriting(vectors.path, output, vertices)
    if crs is not None:
        check_map_code(crs)
    scene, registration = read_raw_scene(scene_model)
    ground = read_terrain(terrain, options.height_sigma_m)
    layer = read_pixel_layer(vectors.path, vectors.layer)
    shapes = _in_image(layer, scene, options)
    sources = _error_sources(scene_model, registration, options)
    crs = crs or default_crs(output, scene)
    corrected = correct_vectors(
        shapes, scene, ground, crs, sources=sources, tolerance_px=options.tolerance_px
    )
    refuse_missed(corrected.missed, missed_place(corrected), options)
    features, renamed = _write_corrected(corrected, layer, crs, output, vertices)
    used = corrected.shapes.index[_entries(corrected)]
    accuracy, frame = corrected.accuracy, None if registration is None else registration.frame
    stated = vertices_accuracy(accuracy.relative_ce90_m[used], accuracy.on_the_earth_ce90_m[used], frame)
    return CorrectedFile(
        output,
        crs,
        "metres above the ellipsoid" if has_heights(crs) else ground.vertical,
        features,
        len(used),
        corrected.added,
        tuple((np.flatnonzero(corrected.missed) + 1).tolist()),
        corrected.height_sigma_m,
        stated.relative_to_control_points,
        stated.on_the_earth,
        by_number(layer.unusable),
        renamed,
        gathered(scene.statements + ground.statements + layer.statements),
    )


def _in_image(layer: VectorLayer, scene: Scene, options: CorrectionOptions) -> Shapes:
    """The geometries of a layer in lines and samples of a scene, all of them inside its image."""
    shapes = shapes_of(shapely.force_2d(layer.geometries))
    refuse_longitudes(shapes.vertices, scene)
    check_inside(shapes.vertices, scene.image.shape, options.pixels, options.margin_px)
    return shapes.with_vertices(line_sample_of_xy(shapes.vertices, options.pixels))


def _error_sources(
    scene_model: SceneModel,
    registration: CorrectionAccuracy | None,
    options: CorrectionOptions,
) -> ErrorSources:
    """What is stated of the errors of model and vertices."""
    model_sigma_m = float("nan") if scene_model.sigma_m is None else scene_model.sigma_m
    return ErrorSources(registration, model_sigma_m, options.sigma_px)


def _entries(corrected: CorrectedVectors) -> IntArray:
    """Entries of the vertices of features that were not missed."""
    return np.flatnonzero(~corrected.missed[corrected.shapes.geometry_of])


def _write_corrected(
    corrected: CorrectedVectors, layer: VectorLayer, crs: str, output: Path, vertices: Path | None
) -> tuple[int, dict[str, str]]:
    """Write corrected features, and their vertices; returns the number of features, renamed columns."""
    out, accuracy = corrected.shapes, corrected.accuracy
    ce90_m = {RELATIVE_CE90: accuracy.relative_ce90_m, ON_THE_EARTH_CE90: accuracy.on_the_earth_ce90_m}
    columns = {name: out.largest(values) for name, values in ce90_m.items()}
    is_kept = ~corrected.missed
    is_kept[list(layer.unusable)] = False
    kept = np.flatnonzero(is_kept)
    renamed = write_layer(output, layer.changed(geometries_of(out), columns, crs).take(kept))
    if vertices is not None:
        entries = _entries(corrected)
        used = out.index[entries]
        places = {name: corrected.line_sample[used, k] for k, name in enumerate(("line", "sample"))}
        table = places | {name: values[used] for name, values in ce90_m.items()}
        write_vertices(vertices, out, entries, table, crs)
    return len(kept), renamed


def project_file(
    vectors: VectorFile,
    scene_model: SceneModel,
    terrain: TerrainFile,
    output: Path,
    *,
    vertices: Path | None = None,
    options: ProjectionOptions = _PROJECTION,
) -> ProjectedFile:
    """Write vectors of the map in the pixel coordinates of a raw scene.

    Args:
        vectors: with a reference system; features that the scene does not show are left out.
        scene_model: the scene and its model.
        terrain: the ground; it has the heights of vectors without heights.
        output: file to write; an existing one is replaced.
        vertices: file to write with every vertex and its ground position; None for none.
        options: of the projection.

    Raises:
        InputError: a file cannot be used, or places have no height.
    """
    check_options(options)
    refuse_overwriting(vectors.path, output, vertices)
    scene, _ = read_raw_scene(scene_model)
    ground = read_terrain(terrain)
    layer = read_map_layer(vectors.path, vectors.layer)
    crs = _map_of(vectors, layer)
    near = _near(layer, ground_outline(scene, ground, crs), clip=options.clip)
    projected = project_vectors(shapes_of(near), scene, ground, crs, tolerance_px=options.tolerance_px)
    in_image, missed = geometries_of(projected.shapes), projected.missed
    in_image[missed] = None
    border = image_outline(scene.image.shape)
    rows = np.flatnonzero(shapely.intersects(in_image, border))
    refuse_missed(missed, f"feature {int(np.argmax(missed)) + 1}" if missed.any() else "", options)
    if options.clip:
        in_image = cut(in_image, border)
    shapes = shapes_of(in_image)
    xy = xy_of_line_sample(shapes.vertices[:, :2], options.pixels)
    drawn = geometries_of(shapes.with_vertices(xy))
    shown = layer.changed(drawn, {HIDDEN: hidden_share(projected)}, None).take(rows)
    renamed = write_layer(output, shown)
    entries = np.flatnonzero(np.isin(projected.shapes.geometry_of, rows))
    used = projected.shapes.index[entries]
    if vertices is not None:
        _write_projected_vertices(vertices, projected, entries, options)
    return ProjectedFile(
        output,
        options.pixels,
        len(rows),
        len(used),
        projected.added,
        int(projected.hidden[used].sum()),
        len(layer.geometries) - len(rows) - int(missed.sum()) - len(layer.unusable),
        tuple((np.flatnonzero(missed) + 1).tolist()),
        by_number(layer.unusable),
        renamed,
        gathered(scene.statements + ground.statements + layer.statements),
    )


def _near(layer: VectorLayer, outline: shapely.Polygon, *, clip: bool) -> Geometries:
    """The geometries that meet an outline, cut along it where they are to be; None for the others."""
    geometries = layer.geometries.copy()
    geometries[~shapely.intersects(geometries, outline)] = None
    return cut(geometries, outline) if clip else geometries


def _map_of(vectors: VectorFile, layer: VectorLayer) -> str:
    """The reference system of vectors, which has to be one of a map."""
    if layer.crs is None:
        raise InputError(
            f"{vectors.path}: no known coordinate reference system found; state that of a map in the "
            "file"
        )
    try:
        check_map(layer.crs)
    except InputError as error:
        raise InputError(f"{vectors.path}: {error}") from None
    return layer.crs


def _write_projected_vertices(
    path: Path, projected: ProjectedVectors, entries: IntArray, options: ProjectionOptions
) -> None:
    """Write every vertex in pixel coordinates, with its ground position and whether it is hidden."""
    used = projected.shapes.index[entries]
    lon_lat_h = projected.lon_lat_h[used]
    table = {"lon": lon_lat_h[:, 0], "lat": lon_lat_h[:, 1], "height_m": lon_lat_h[:, 2]}
    xy = xy_of_line_sample(projected.shapes.vertices, options.pixels)
    in_pixels = projected.shapes.with_vertices(xy)
    write_vertices(path, in_pixels, entries, table | {HIDDEN: projected.hidden[used]}, None)


def by_number(rows: dict[int, str]) -> dict[int, str]:
    """What rows of a layer have, by the numbers of their features, from 1."""
    return {row + 1: value for row, value in sorted(rows.items())}
