"""Reference ortho-images with terrains, to register scenes on where there are no control points."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amers.app.errors import InputError
from amers.app.usecases.registration.control_sources import ControlSet
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.map_statements import map_statements, unused_heights
from amers.services.formats.images.mosaic import open_mosaic, open_piece
from amers.services.formats.images.raster import RasterImage, map_grid_of, shift_of_grid
from amers.services.formats.pieces import IMAGE_SUFFIXES, IMAGES, PlaceList, Source, pieces_of
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource
from amers.services.map_grid import MapGrid
from amers.services.matching.reference_image import Reference
from amers.services.registration.context import SearchStage
from amers.services.registration.on_points import Registration
from amers.services.registration.on_reference import register_on_reference
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.reference_points import ReferenceChips, reference_points
from amers.services.registration.scene_marks import SceneMarks, with_marks
from amers.services.reports.report import BlockUsed
from amers.services.sensors.ortho import OrthoModel
from amers.services.statements import Statements
from amers.services.types import Array, Frame, Progress

LOCAL_SIGMA_PX = 0.3
"""Assumed local error of an ortho-image, independent between places: one sigma, in its own pixels."""
COMMON_SIGMA_PX = 0.1
"""Assumed error that all places share, from shadows and leaning roofs: one sigma, in its own pixels."""


@dataclass(frozen=True)
class ReferenceFiles:
    """The files of a reference.

    Attributes:
        image: ortho-image: GeoTIFF (or COG) or JPEG 2000 on a map, or its pieces in files, a folder, an
            archive, a list or a catalogue; see `amers.services.formats.pieces`.
        terrain: heights of the same ground; only scenes that are ortho-images can be registered without.
        sigma_m: accuracy of the image's frame on the Earth, one standard deviation per coordinate; None
            when unknown.
        sigma_up_m: the same of the heights of its terrain.
    """

    image: Source
    terrain: TerrainFile | None = None
    sigma_m: float | None = None
    sigma_up_m: float | None = None


@dataclass(frozen=True)
class CoveringReference:
    """A reference that shows the ground of a scene.

    Attributes:
        name: for people.
        files: on this machine.
        id: of its row in the store; None for files that a command names.
        gsd_m: its ground sampling; NaN for files that a command names.
        earlier_places: (k, 3) ground positions where earlier scenes matched it, the best first.
    """

    name: str
    files: ReferenceFiles
    id: int | None = None
    gsd_m: float = float("nan")
    earlier_places: Array | None = None


FindReference = Callable[[Array], CoveringReference | None]
"""Finds a reference that shows the ground of an outline (n, 2) of lon, lat; None without any."""


def given_reference(files: ReferenceFiles) -> FindReference:
    """A source of one reference, whatever the outline."""
    return lambda outline: CoveringReference(files.image.name, files)


def register_on(
    covering: CoveringReference,
    reference: Reference,
    scene: Scene,
    options: RegistrationOptions,
    *,
    marks: SceneMarks | None = None,
    progress: Progress,
    stages: list[SearchStage] | None = None,
) -> tuple[Registration, ControlSet]:
    """Register a scene on a reference.

    Args:
        covering: names the reference, with the places where earlier scenes matched it.
        reference: opened from its files.
        scene: as delivered.
        options: of the registration.
        marks: of a person in the scene: observations of the same adjustment.
        progress: receives the fraction done and a message.
        stages: receives the searches, also one that is refused.

    Returns:
        The registration, and its places on the reference as control points.
    """
    registration = register_on_reference(
        scene,
        reference,
        options,
        marks=marks,
        progress=progress,
        earlier_places=covering.earlier_places,
        stages=stages,
    )
    places = len(registration.measures.point_id) - (0 if marks is None else len(marks))
    lon_lat_h = registration.measures.lon_lat_h[:places]
    points = reference_points(lon_lat_h, reference)
    if marks is not None:
        points = with_marks(points, marks)
    chips = ReferenceChips(reference, lon_lat_h)
    used = BlockUsed(covering.name, "reference image")
    return registration, ControlSet(points, chips, (used,))


def check_map(image: Source) -> None:
    """Refuse a reference image that lies on no map, before any scene is registered on it.

    What lies in a folder, an archive or a catalogue is read with the first scene.

    Raises:
        InputError: the image cannot be read, or has no coordinate reference system.
    """
    for place in image.places if isinstance(image, PlaceList) else (image,):
        if isinstance(place, Path) and place.suffix.lower() in IMAGE_SUFFIXES:
            _on_map(place)[0].close()


def read_reference(files: ReferenceFiles, outline: Array | None = None) -> Reference:
    """Open a reference; its files stay open and are read by windows.

    Args:
        files: of the reference.
        outline: (n, 2) lon, lat where it is needed; pieces that lie apart are left out. None takes all.

    Raises:
        InputError: the image has no coordinate reference system, or the terrain cannot be used.
    """
    image = _opened(files.image, outline)
    gsd_m = image.grid.gsd_m
    terrain = None if files.terrain is None else read_terrain(files.terrain, outline=outline)
    return Reference(
        image=image.pixels,
        model=OrthoModel(image.grid),
        terrain=terrain,
        sigma_m=LOCAL_SIGMA_PX * gsd_m,
        common_sigma_m=COMMON_SIGMA_PX * gsd_m,
        frame=Frame.from_sigmas(
            math.nan if files.sigma_m is None else math.hypot(files.sigma_m, image.shift_sigma_m),
            math.nan if files.sigma_up_m is None else files.sigma_up_m,
        ),
        statements=(
            *image.statements,
            *(() if terrain is None else terrain.statements),
        ),
    )


@dataclass(frozen=True)
class _Opened:
    """An opened ortho-image, or several as one."""

    pixels: ImageSource
    grid: MapGrid
    statements: Statements
    shift_sigma_m: float


def _opened(source: Source, outline: Array | None) -> _Opened:
    pieces = pieces_of(source, IMAGES, outline)
    if len(pieces) > 1:
        mosaic = open_mosaic(pieces, outline)
        return _Opened(mosaic, mosaic.grid, mosaic.statements, mosaic.shift_sigma_m)
    image, grid = _on_map(pieces[0])
    shift = shift_of_grid(image, grid)
    said = (*image.statements, *map_statements(image, grid, shift), *unused_heights(image, grid))
    return _Opened(image, grid, said, shift.sigma_m)


def _on_map(path: FilePlace) -> tuple[RasterImage, MapGrid]:
    """An opened image and its map."""
    image = open_piece(path)
    grid = map_grid_of(image)
    if grid is None:
        image.close()
        raise InputError(
            f"{path}: expected an ortho-image on a map, found no coordinate reference system"
        )
    return image, grid
