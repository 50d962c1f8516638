"""Vectors between a raw scene and the map: for the command line, and as a process."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from amers.app.errors import InputError
from amers.app.usecases.registered_scene import SceneModel, read_raw_scene
from amers.app.usecases.terrain_file import HEIGHT_SIGMA_POSTINGS, TerrainFile, read_terrain
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
from amers.services.formats.vector.layers import read_layer, write_layer
from amers.services.formats.vector.pixel_coordinates import (
    PixelOrigin,
    check_inside,
    line_sample_of_xy,
    xy_of_line_sample,
)
from amers.services.map_grid import check_map, check_map_code
from amers.services.quality.accuracy_statement import StatedAccuracy, vertices_accuracy
from amers.services.vectors.accuracy import ErrorSources
from amers.services.vectors.correct import correct_vectors, has_heights, missed_place
from amers.services.vectors.project import (
    cut,
    ground_outline,
    hidden_share,
    image_outline,
    project_vectors,
)
from amers.services.vectors.shapes import geometries_of, shapes_of

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
        height_sigma_m: of the terrain, as used.
        relative_to_control_points, on_the_earth: predicted accuracy of the vertices.
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

    def __repr__(self) -> str:
        relative, on_the_earth = self.relative_to_control_points, self.on_the_earth
        return (
            f"CorrectedFile {self.path}: {self.crs}, {self.features} features with {self.vertices} "
            f"vertices\n"
            f"  {relative.label}: {relative.words}\n"
            f"  {on_the_earth.label}: {on_the_earth.words}"
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
        unusable, renamed: as for `CorrectedFile`.
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
    ground = read_terrain(terrain)
    layer = read_layer(vectors.path, vectors.layer)
    shapes = shapes_of(shapely.force_2d(layer.geometries))
    refuse_longitudes(shapes.vertices, scene)
    check_inside(shapes.vertices, scene.image.shape, options.pixels, options.margin_px)
    height_sigma_m = options.height_sigma_m
    if height_sigma_m is None:
        height_sigma_m = HEIGHT_SIGMA_POSTINGS * ground.posting_m
    model_sigma_m = float("nan") if scene_model.sigma_m is None else scene_model.sigma_m
    crs = crs or default_crs(output, scene)
    corrected = correct_vectors(
        shapes.with_vertices(line_sample_of_xy(shapes.vertices, options.pixels)),
        scene,
        ground,
        crs,
        sources=ErrorSources(registration, model_sigma_m, height_sigma_m, options.sigma_px),
        tolerance_px=options.tolerance_px,
    )
    refuse_missed(corrected.missed, missed_place(corrected), options)
    relative_m = corrected.accuracy.relative_ce90_m
    earth_m = corrected.accuracy.on_the_earth_ce90_m
    out = corrected.shapes
    columns = {RELATIVE_CE90: out.largest(relative_m), ON_THE_EARTH_CE90: out.largest(earth_m)}
    is_kept = ~corrected.missed
    is_kept[list(layer.unusable)] = False
    kept = np.flatnonzero(is_kept)
    geometries = geometries_of(out)
    renamed = write_layer(output, layer.changed(geometries, columns, crs).take(kept))
    entries = np.flatnonzero(~corrected.missed[out.geometry_of])
    used = out.index[entries]
    if vertices is not None:
        table = {
            "line": corrected.line_sample[used, 0],
            "sample": corrected.line_sample[used, 1],
            RELATIVE_CE90: relative_m[used],
            ON_THE_EARTH_CE90: earth_m[used],
        }
        write_vertices(vertices, out, entries, table, crs)
    frame = None if registration is None else registration.frame
    stated = vertices_accuracy(relative_m[used], earth_m[used], frame)
    return CorrectedFile(
        output,
        crs,
        "metres above the ellipsoid" if has_heights(crs) else ground.vertical,
        len(kept),
        len(used),
        corrected.added,
        tuple((np.flatnonzero(corrected.missed) + 1).tolist()),
        height_sigma_m,
        stated.relative_to_control_points,
        stated.on_the_earth,
        by_number(layer.unusable),
        renamed,
    )


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
    layer = read_layer(vectors.path, vectors.layer)
    if layer.crs is None:
        raise InputError(
            f"{vectors.path}: no known coordinate reference system found, one of a map expected"
        )
    try:
        check_map(layer.crs)
    except InputError as error:
        raise InputError(f"{vectors.path}: {error}") from None
    near = ground_outline(scene, ground, layer.crs)
    geometries = layer.geometries.copy()
    geometries[~shapely.intersects(geometries, near)] = None
    if options.clip:
        geometries = cut(geometries, near)
    projected = project_vectors(
        shapes_of(geometries), scene, ground, layer.crs, tolerance_px=options.tolerance_px
    )
    border = image_outline(scene.image.shape)
    missed = projected.missed
    in_image = geometries_of(projected.shapes)
    in_image[missed] = None
    shown = shapely.intersects(in_image, border)
    place = f"feature {int(np.argmax(missed)) + 1}" if missed.any() else ""
    refuse_missed(missed, place, options)
    if options.clip:
        in_image = cut(in_image, border)
    shapes = shapes_of(in_image)
    drawn = geometries_of(
        shapes.with_vertices(xy_of_line_sample(shapes.vertices[:, :2], options.pixels))
    )
    rows = np.flatnonzero(shown)
    renamed = write_layer(
        output, layer.changed(drawn, {HIDDEN: hidden_share(projected)}, None).take(rows)
    )
    kept = np.isin(projected.shapes.geometry_of, rows)
    entries = np.flatnonzero(kept)
    used = projected.shapes.index[entries]
    if vertices is not None:
        lon_lat_h = projected.lon_lat_h[used]
        table = {"lon": lon_lat_h[:, 0], "lat": lon_lat_h[:, 1], "height_m": lon_lat_h[:, 2]}
        xy = xy_of_line_sample(projected.shapes.vertices, options.pixels)
        in_pixels = projected.shapes.with_vertices(xy)
        write_vertices(vertices, in_pixels, entries, table | {HIDDEN: projected.hidden[used]}, None)
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
    )


def by_number(rows: dict[int, str]) -> dict[int, str]:
    """What rows of a layer have, by the numbers of their features, from 1."""
    return {row + 1: value for row, value in sorted(rows.items())}
