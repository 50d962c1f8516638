"""The process `make-mosaic`: uploaded scenes on one map, on a terrain of the server."""

import math
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np

from amers.app.auth import Scope
from amers.app.config import Settings
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases import quotas
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.mosaic import MosaicGround, box_outline, write_mosaic
from amers.app.usecases.mosaic_scenes import MosaicSource
from amers.app.usecases.orthorectification import MapLimits
from amers.app.usecases.processes import STATEMENTS_VALUE, Commit, Process, Work, stated_document
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import naming
from amers.app.usecases.server_files import file_below
from amers.app.usecases.stored_scenes import check_scenes, local_scene, stored_scenes
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.formats.images.ortho import BandForm
from amers.services.map_grid import check_map_code
from amers.services.mosaic.layout import Layout, MosaicMap
from amers.services.mosaic.options import MosaicOptions
from amers.services.orthorectification.rectify import OrthoOptions

MOSAIC_NAME = "mosaic.tif"
WIDEST_FEATHER_PX = 512.0
_NUMBER_BYTES = 2


@dataclass(frozen=True)
class MakeMosaic:
    """The inputs of a mosaic.

    Attributes:
        scenes: ids of 1 to 100 uploaded scenes with the same bands. A scene that lies completely within
            earlier scenes of this list is not shown.
        registrations: ids of the jobs that registered the scenes, such as one job register-scenes. If
            several jobs registered the same scene, the last one counts. By default none: the models
            uploaded with the scenes are used.
        dem: heights of the ground, or a surface: a path below AMERS_REFERENCE_FOLDER.
        vertical: vertical datum of these heights, if the file does not state it.
        geoid: grid file of the geoid, if PROJ has none: a path below AMERS_REFERENCE_FOLDER.
        height_m: height of flat ground above the ellipsoid, metres, instead of `dem`. Ortho-images need
            neither.
        crs: code of the reference system of the map; by default the UTM zone at the centre of the
            scenes.
        gsd_m: pixel size of the map, metres; by default the ground sampling of the finest scene.
        bbox: bounding box of the map: west, south, east, north in degrees; by default the ground of all
            scenes.
        level: change the grey values of the scenes so that they agree where they overlap.
        feather_px: width of the strip along a seam in which both scenes are blended, 0 to 512 pixels.
        hide: do not use a scene where the ground is hidden from it by other ground; other scenes fill
            this ground.
    """

    scenes: tuple[UUID, ...]
    registrations: tuple[UUID, ...] = ()
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None
    height_m: float | None = None
    crs: str | None = None
    gsd_m: float | None = None
    bbox: tuple[float, float, float, float] | None = None
    level: bool = False
    feather_px: float = 0.0
    hide: bool = False


def _check(connection: Connection, caller: Token, inputs: MakeMosaic) -> None:
    if inputs.gsd_m is not None and not inputs.gsd_m > 0.0:
        raise InputError(f"gsd_m: {inputs.gsd_m:g} found, a length above 0 m expected")
    if not 0.0 <= inputs.feather_px <= WIDEST_FEATHER_PX:
        raise InputError(f"feather_px: {inputs.feather_px:g} found, 0 to {WIDEST_FEATHER_PX:g} expected")
    if inputs.height_m is not None and not math.isfinite(inputs.height_m):
        raise InputError(f"height_m: {inputs.height_m:g} found, metres above the ellipsoid expected")
    if inputs.dem is not None and inputs.height_m is not None:
        raise InputError("dem, height_m: only one of both is expected")
    if inputs.dem is None and (inputs.vertical is not None or inputs.geoid is not None):
        raise InputError(
            "vertical, geoid: given without dem, whose heights they describe; add dem, or leave them out"
        )
    if inputs.crs is not None:
        with naming("crs"):
            check_map_code(inputs.crs)
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)
    _wanted(inputs)
    check_scenes(connection, caller, inputs.scenes, fewest=1)
    stored_scenes(connection, inputs.scenes, inputs.registrations)


def _wanted(inputs: MakeMosaic) -> MosaicMap:
    """The map.

    Raises:
        InputError: the box is none.
    """
    if inputs.bbox is None:
        return MosaicMap(inputs.crs, inputs.gsd_m)
    west, south, east, north = inputs.bbox
    inside = np.abs([west, east, south, north]) <= [180.0, 180.0, 90.0, 90.0]
    if not (inside.all() and south < north and west != east):
        raise InputError(
            f"bbox: {list(inputs.bbox)} found, west, south, east, north in degrees expected"
        )
    return MosaicMap(inputs.crs, inputs.gsd_m, box_outline(*inputs.bbox))


def _ground(settings: Settings, inputs: MakeMosaic) -> MosaicGround:
    """The ground, of a file below the folder of references or of one height.

    Raises:
        InputError: AMERS_REFERENCE_FOLDER is not set, or a path does not lead to a file below it.
    """
    if inputs.dem is None:
        return MosaicGround(None, inputs.height_m)
    if settings.reference_folder is None:
        raise InputError("dem: no file can be used, because AMERS_REFERENCE_FOLDER is not set")
    below = partial(file_below, settings.reference_folder, setting="AMERS_REFERENCE_FOLDER")
    geoid = None if inputs.geoid is None else below(inputs.geoid, field="geoid")
    dem = below(inputs.dem, field="dem")
    return MosaicGround(TerrainFile(dem, inputs.vertical, geoid, is_uploaded=True))


def _run(work: Work) -> Commit:
    """Make the mosaic of uploaded scenes and put it into the storage."""
    inputs: MakeMosaic = work.inputs
    with work.database.snapshot() as connection:
        stored = stored_scenes(connection, inputs.scenes, inputs.registrations)
        owner = work.job.owner
        room = None if owner is None else quotas.room_left(connection, work.settings, owner)

    def check(layout: Layout, form: BandForm) -> None:
        scenes = [one.scene for one in layout.scenes]
        pixel_bytes = form.bands * np.dtype(form.dtype).itemsize + _NUMBER_BYTES
        MapLimits(room).check(scenes, layout.grid, pixel_bytes)

    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
        keys = [key for one in stored for key in one.keys]
        stack.enter_context(suspecting_damage(work.database, work.storage, keys))
        images = [MosaicSource(*local_scene(work, one, stack), name=str(one.row.id)) for one in stored]
        mosaic = write_mosaic(
            images,
            _ground(work.settings, inputs),
            folder / MOSAIC_NAME,
            MosaicOptions(inputs.level, None, inputs.feather_px, OrthoOptions(hide=inputs.hide)),
            wanted=_wanted(inputs),
            place=WorkPlace(most_bytes=room),
            check=check,
            progress=work.progress,
        )
        made = (mosaic.path, mosaic.sources, mosaic.seams)
        files = store_results(work, {path.name: path for path in made})

    def commit(connection: Connection) -> dict[str, Any]:
        told = asdict(mosaic)
        times = [one["acquired_at"] for one in mosaic.scenes]
        told["scenes"] = [
            {**one, "acquired_at": None if time is None else time.isoformat()}
            for one, time in zip(mosaic.scenes, times, strict=True)
        ]
        return {
            **{name: told[name] for name in MAKE_MOSAIC.values},
            "statements": stated_document(mosaic.statements),
            "files": files,
        }

    return commit


MAKE_MOSAIC = Process(
    id="make-mosaic",
    title="Make a mosaic",
    description="Make one ortho-image of uploaded scenes on a terrain of the server, with seams "
    "where the scenes agree best, and measure the steps at the seams. Register the scenes "
    "together first, so that their models agree.",
    scope=Scope.ADMIN,
    inputs=MakeMosaic,
    outputs={
        MOSAIC_NAME: "The mosaic, a cloud-optimised GeoTIFF with the bands of the scenes.",
        "mosaic.sources.tif": "The number of the scene of each pixel, from 1; 0 where none has data.",
        "mosaic.seams.gpkg": "The ground that each scene shows, with its time and accuracy.",
    },
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the map, px"},
        "samples": {"type": "integer", "title": "Samples of the map, px"},
        "bands": {"type": "integer", "title": "Bands of the scenes"},
        "gsd_m": {"type": "number", "title": "Side of a pixel, metres"},
        "crs": {"type": "string", "title": "Reference system of the map"},
        "seen": {"type": "number", "title": "Share of the map's pixels with data"},
        "scenes": {
            "type": "array",
            "items": {"type": "object"},
            "title": "Scenes on the map with their number, accuracy, share, gain and offset",
        },
        "left_out": {
            "type": "array",
            "items": {"type": "string"},
            "title": "Scenes outside the map",
        },
        "seam_step": {"type": ["object", "null"], "title": "Steps at all seams together, metres"},
        "pairs": {
            "type": "array",
            "items": {"type": "object"},
            "title": "Steps at the seams of every pair of scenes, metres",
        },
        "vertical": {"type": "string", "title": "Source of the vertical datum of the ground"},
        "statements": STATEMENTS_VALUE,
    },
)
