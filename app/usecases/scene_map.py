"""The process that puts a registered scene on the map, before and after, and its tiles."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.jobs.jobs import Job
from amers.app.db.tokens import Token
from amers.app.errors import DamagedFile, InputError, NotFound
from amers.app.storage import Storage
from amers.app.usecases.damage import named_by_row, suspecting_damage
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.registered_scene import SceneModel, read_registered_scene
from amers.app.usecases.results import result_key, store_results
from amers.app.usecases.scene_inputs import (
    check_file_names,
    check_scene,
    naming,
    present_scene,
    registered_model_keys,
    registration_files,
)
from amers.app.usecases.scenes import local_image, stored_keys
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.errors import FormatError
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.formats.gcp.json_formats import parse_geojson_points
from amers.services.formats.images.map_tiles import read_map_tile, write_map_tiles
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.tiles import grey_range
from amers.services.formats.text_files import read_text
from amers.services.imagery.scene import Scene, common_footprint, scene_footprint
from amers.services.orthorectification.outline import image_outline
from amers.services.orthorectification.point_terrain import terrain_of_points
from amers.services.orthorectification.rectify import OrthoOptions, orthorectify
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits, TilePlace, choose_tiles
from amers.services.terrain import Terrain
from amers.services.types import Array, Progress, no_progress

Layer = Literal["raw", "registered"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
POINTS_NAME = "control_points.geojson"
_LIMITS = "tile_limits"


@dataclass(frozen=True)
class MapScene:
    """The inputs of a map of a scene.

    Attributes:
        scene: id of an uploaded scene.
        registration: id of the job that registered the scene.
        model: name of the uploaded file with the scene's model; by default it is found by its name.
        dem: name of a terrain file uploaded beside the image; by default heights are interpolated
            between the control points of the registration.
        vertical: vertical datum of the heights, where the terrain file does not state it.
        geoid: name of an uploaded grid file of the geoid.
    """

    scene: UUID
    registration: UUID
    model: str | None = None
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None


@dataclass(frozen=True)
class MappedScene:
    """A scene on the map.

    Attributes:
        limits: of its tiles, from the finest zoom to the coarsest.
        heights: where the heights of the ground come from.
        bounds: west, south, east and north of the scene, degrees; the east may exceed 180.
        outlines: (m, 2) lon, lat of the edge of the pixels through each model, degrees, not closed.
    """

    limits: list[TileLimits]
    heights: str
    bounds: tuple[float, float, float, float]
    outlines: dict[Layer, Array]


def map_scene(
    files: SceneModel,
    terrain: TerrainFile | None,
    outputs: dict[Layer, Path],
    progress: Progress = no_progress,
) -> MappedScene:
    """Write the tiles of a scene through its delivered and through its registered model.

    Args:
        files: the scene, its model and the folder of its registration.
        terrain: the ground; None interpolates it between the control points of the registration.
        outputs: the files to write.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used.
    """
    assert files.registration is not None
    raw, _ = read_registered_scene(SceneModel(files.image, files.model))
    registered, _ = read_registered_scene(files)
    scenes: dict[Layer, Scene] = {"raw": raw, "registered": registered}
    ground = _ground(files.registration, terrain, [raw, registered])
    limits = choose_tiles([raw, registered], ground.range_m())
    greys = grey_range(raw.image)
    options = OrthoOptions(window_px=TILE_PX)
    for number, (layer, scene) in enumerate(scenes.items()):

        def report(fraction: float, message: str, number: int = number) -> None:
            progress((number + fraction) / len(scenes), "drawing the tiles")

        windows = orthorectify(
            [scene.image], scene.model, ground, limits[0].grid(), options, progress=report
        )
        write_map_tiles(outputs[layer], limits, windows, greys)
    outlines = {layer: image_outline(scene, ground) for layer, scene in scenes.items()}
    for scene in scenes.values():
        assert isinstance(scene.image, RasterImage)
        scene.image.close()
    footprint = scene_footprint(registered, ground.range_m())
    bounds = (*footprint.min(axis=0).tolist(), *footprint.max(axis=0).tolist())
    return MappedScene(limits, ground.vertical, bounds, outlines)


def _ground(registration: Path, terrain: TerrainFile | None, scenes: Sequence[Scene]) -> Terrain:
    """The terrain in a file, or between the control points of a registration, below all the scenes."""
    if terrain is not None:
        return read_terrain(terrain).around(common_footprint(scenes))
    path = registration / POINTS_NAME
    points = parse_geojson_points(read_text(path), POINTS_NAME)
    heights = points.lon_lat_h[:, 2]
    range_m = float(heights.min()), float(heights.max())
    return terrain_of_points(points.lon_lat_h, common_footprint(scenes, range_m))


def scene_tile(storage: Storage, job: Job, layer: Layer, place: TilePlace) -> bytes:
    """A tile of the map that a job made of a scene.

    Raises:
        NotFound: the job made no such map, or the scene does not lie on this tile.
        DamagedFile: the stored tiles cannot be read.
    """
    key = result_key(job, _file_name(layer))
    limits = [TileLimits(**one) for one in (job.results or {}).get(_LIMITS, [])]
    with named_by_row(key):
        reader = storage.reader(key)
    try:
        tile = read_map_tile(reader.read, limits, place)
    except FormatError as error:
        raise DamagedFile(key, str(error)) from error
    finally:
        reader.close()
    if tile is None:
        zooms = f"{limits[-1].zoom} to {limits[0].zoom}" if limits else "none"
        raise NotFound(
            f"no tile {place.zoom}/{place.row}/{place.column} of the scene: its zooms are {zooms}, rows "
            f"and columns are in {_LIMITS} of the results"
        )
    return tile


def _file_name(layer: Layer) -> str:
    return f"{layer}.tiles"


def _check(connection: Connection, caller: Token, inputs: MapScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "model", "dem", "geoid")
    if inputs.dem is None and (inputs.vertical is not None or inputs.geoid is not None):
        raise InputError("vertical, geoid: given without dem, the terrain file that they describe")
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)
    _keys(connection, inputs)


def _keys(connection: Connection, inputs: MapScene) -> list[str]:
    """The storage keys of the files of the registration.

    Raises:
        InputError: the job did not register the scene, or made no correction.
        Conflict: its results were removed.
    """
    model = registered_model_keys(connection, inputs.scene, inputs.registration)
    return [*model, registration_files(connection, inputs.scene, inputs.registration)[POINTS_NAME]]


@contextmanager
def _files(work: Work) -> Iterator[tuple[SceneModel, TerrainFile | None]]:
    """The files of a job, until the context closes; damage of stored ones is looked for on an error."""
    inputs: MapScene = work.inputs
    with work.database.snapshot() as connection:
        scene = present_scene(connection, inputs.scene)
        keys = _keys(connection, inputs)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        for key in keys:
            with named_by_row(key):
                registration = work.storage.fetch(key, Path(folder)).parent
        model = image.with_name(inputs.model) if inputs.model else None
        geoid = image.with_name(inputs.geoid) if inputs.geoid else None
        terrain = None
        if inputs.dem is not None:
            terrain = TerrainFile(image.with_name(inputs.dem), inputs.vertical, geoid, is_uploaded=True)
        with suspecting_damage(work.database, work.storage, [*stored_keys(scene), *keys]):
            yield SceneModel(image, model, registration), terrain


def _run(work: Work) -> Commit:
    """Draw the tiles of a registered scene and put them into the storage."""
    with TemporaryDirectory(prefix="amers-") as folder:
        outputs: dict[Layer, Path] = {layer: Path(folder) / _file_name(layer) for layer in LAYERS}
        with _files(work) as (scene, terrain):
            mapped = map_scene(scene, terrain, outputs, work.progress)
        stored = store_results(work, {path.name: path for path in outputs.values()})

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            _LIMITS: [asdict(limits) for limits in mapped.limits],
            "bounds": list(mapped.bounds),
            "heights": mapped.heights,
            "outlines": {layer: ring.tolist() for layer, ring in mapped.outlines.items()},
            "files": stored,
        }

    return commit


MAP_SCENE = Process(
    id="map-scene",
    title="Show a registered scene on the map",
    description="Draw an uploaded scene on the web map as grey tiles at decreasing resolutions, "
    "with its delivered model (raw) and with its registered model.",
    scope=Scope.REGISTER,
    inputs=MapScene,
    outputs={
        "raw.tiles": "The tiles through the delivered model; the service sends them one by one.",
        "registered.tiles": "The tiles through the registered model.",
    },
    check=_check,
    run=_run,
    values={
        _LIMITS: {
            "type": "array",
            "items": {"type": "object"},
            "title": "First and last rows and columns of tiles, from the finest zoom to the coarsest",
        },
        "bounds": {
            "type": "array",
            "items": {"type": "number"},
            "title": "West, south, east and north of the scene, degrees",
        },
        "heights": {"type": "string", "title": "Origin of the heights of the ground"},
        "outlines": {
            "type": "object",
            "title": "Edge of the pixels on the ground, raw and registered: longitudes and latitudes",
        },
    },
)
