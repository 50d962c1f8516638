"""Orthorectify a scene through its model and a terrain: for the command line, and as a process."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np

from amers.app.auth import Scope
from amers.app.db import scenes
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError, TooLarge
from amers.app.usecases import quotas
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.processes import (
    STATEMENTS_VALUE,
    Commit,
    Process,
    Work,
    stated_document,
)
from amers.app.usecases.quotas import FREE_ROOM
from amers.app.usecases.registered_scene import registered_scene
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import (
    check_file_names,
    check_scene,
    naming,
    registered_model_keys,
)
from amers.app.usecases.stored_scenes import local_scene, stored_scenes
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.errors import CoverageError
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.formats.pieces import paths_of
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.map_grid import MapGrid, check_map_code
from amers.services.orthorectification.rectify import (
    OrthoOptions,
    OrthoWindow,
    choose_grid,
    orthorectify,
    unseen,
)
from amers.services.statements import Statements, Subject, gathered
from amers.services.types import Progress, no_progress

ORTHO_NAME = "ortho.tif"
FINEST_GSD = 0.5
"""A job makes no map that is finer than this share of the ground sampling of its scene."""
MOST_MAP_PIXELS = 16
"""A job makes no map with more than this many times the pixels of its scene: a narrow scene that lies
askew needs up to 10 times as many at its own ground sampling."""
_KEPT_TYPES = ("uint8", "uint16", "int16", "float32")


@dataclass(frozen=True)
class OrthoMap:
    """The map of an ortho-image.

    Attributes:
        crs: coordinate reference system of the map; by default the UTM zone.
        gsd_m: pixel size of the map, metres; by default the ground sampling of the scene.
    """

    crs: str | None = None
    gsd_m: float | None = None


@dataclass(frozen=True)
class Orthorectified:
    """An ortho-image that was written.

    Attributes:
        path: of the image.
        crs: coordinate reference system of its map.
        lines, samples, bands: its size.
        gsd_m: ground sampling, metres.
        seen: share of its pixels that have data.
        error_px: largest difference from the scene's model where the mapping was checked.
        vertical: how the vertical datum of the terrain is known.
        statements: of the files of the scene and the terrain.
    """

    path: Path
    crs: str
    lines: int
    samples: int
    bands: int
    gsd_m: float
    seen: float
    error_px: float
    vertical: str
    statements: Statements = ()

    def __repr__(self) -> str:
        return (
            f"Orthorectified {self.path}: {self.crs}\n"
            f"  {self.lines} x {self.samples} pixels of {self.gsd_m:.2f} m, {self.bands} bands, "
            f"{100.0 * self.seen:.0f} % with data\n"
            f"  heights: {self.vertical}"
        )


@dataclass(frozen=True)
class OrthorectifyScene:
    """The inputs of an orthorectification.

    Attributes:
        scene: id of an uploaded scene.
        dem: name of the terrain file uploaded beside the image.
        model: name of the uploaded file with the scene's model; by default it is found by its name.
        registration: id of the job that registered the scene; its refined model is used.
        vertical: vertical datum of the heights, where the terrain file does not state it.
        geoid: name of an uploaded grid file of the geoid.
        fill_px: voids are filled from heights at most this many nodes away.
        map: reference system and ground sampling of the ortho-image.
        options: of the orthorectification.
    """

    scene: UUID
    dem: str
    model: str | None = None
    registration: UUID | None = None
    vertical: str | None = None
    geoid: str | None = None
    fill_px: int = 0
    map: OrthoMap = field(default_factory=OrthoMap)
    options: OrthoOptions = field(default_factory=OrthoOptions)


@dataclass(frozen=True)
class MapLimits:
    """The limits of the map of a job: what the scene warrants, and the quota of the owner.

    Attributes:
        room_bytes: what is left of the quota; None without one.
    """

    room_bytes: int | None

    def check(self, scenes: Sequence[Scene], grid: MapGrid, pixel_bytes: int) -> None:
        """Refuse a map that the scenes or the quota do not warrant.

        Args:
            scenes: that the map is made from.
            grid: of the map.
            pixel_bytes: size of a pixel with all its bands.

        Raises:
            InputError: the map is finer than the finest scene, or larger than all of them.
            TooLarge: the map does not fit into what is left of the quota.
        """
        require_warranted_gsd(grid.gsd_m, min(scene_gsd_m(scene) for scene in scenes))
        lines, samples = grid.shape
        most = MOST_MAP_PIXELS * sum(math.prod(scene.image.shape) for scene in scenes)
        if lines * samples > most:
            raise InputError(
                f"the map would have {lines} x {samples} pixels, at most {most:,} are allowed "
                f"({MOST_MAP_PIXELS} times the pixels of what it is made from): give a larger `gsd_m`, "
                "or a crs for this part of the world"
            )
        # A third more with overviews; compression makes it smaller.
        size_bytes = lines * samples * pixel_bytes * 4 // 3
        if self.room_bytes is not None and size_bytes > self.room_bytes:
            raise TooLarge(
                f"the map may have {size_bytes} bytes, {self.room_bytes} are left of the storage quota: "
                f"give a larger `gsd_m`, or {FREE_ROOM}"
            )


def require_warranted_gsd(gsd_m: float, of_scene_m: float) -> None:
    """Refuse a map that is much finer than its scene.

    Raises:
        InputError: the ground sampling is below `FINEST_GSD` of that of the scene.
    """
    finest_m = FINEST_GSD * of_scene_m
    # The ground sampling of a scene differs a little from place to place.
    if gsd_m < 0.95 * finest_m:
        raise InputError(
            f"gsd_m: {gsd_m:.4g} m found, at least {finest_m:.4g} m expected, half of the "
            f"{of_scene_m:.4g} m of the scene: a finer map shows no more"
        )


_DEFAULT_MAP = OrthoMap()
_DEFAULT_OPTIONS = OrthoOptions()


def run_orthorectification(
    source: ImageFiles,
    terrain: TerrainFile,
    output: Path,
    *,
    ortho_map: OrthoMap = _DEFAULT_MAP,
    options: OrthoOptions = _DEFAULT_OPTIONS,
    registration: Path | None = None,
    limits: MapLimits | None = None,
    progress: Progress = no_progress,
) -> Orthorectified:
    """Write a scene with all its bands as a cloud-optimised GeoTIFF on a map.

    Pixels of 8 or 16 bits and of 32-bit floating point keep their type; others become floating point.

    Args:
        source: the files of the scene.
        terrain: the ground.
        output: path of the ortho-image; an existing file is replaced.
        ortho_map: reference system and ground sampling.
        options: of the orthorectification.
        registration: folder of the scene's registration, whose model is used; by default the delivered
            one.
        limits: of the map; None on the command line, which has none.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the scene or the terrain cannot be used, or no pixel of the map shows the scene.
        ComputationError: the mapping exceeds the tolerance.
    """
    _check_request(ortho_map, output, (source.image, *paths_of(terrain.dem)))
    # Each band is rectified by itself: none has to lie on another one.
    scene, _ = registered_scene(source, registration, one_band(1))
    raster = scene.image
    assert isinstance(raster, RasterImage | TiledImage)
    ground = read_terrain(terrain)
    bands = [raster.with_mix(one_band(band)) for band in raster.validity.image_bands]
    grid = choose_grid(scene, ground, ortho_map.crs, ortho_map.gsd_m)
    dtype, nodata = pixel_type(raster)
    if limits is not None:
        limits.check([scene], grid, len(bands) * np.dtype(dtype).itemsize)
    counter = DataPixels(partial(unseen, scene, ground))
    windows = counter.count(orthorectify(bands, scene.model, ground, grid, options, progress=progress))
    saturated = next(reversed(raster.saturated_values(1)), None)
    error_px = write_cog(output, grid, windows, BandForm(len(bands), dtype, nodata, saturated))
    raster.close()
    lines, samples = grid.shape
    return Orthorectified(
        path=output,
        crs=ortho_map.crs or grid.crs,
        lines=lines,
        samples=samples,
        bands=len(bands),
        gsd_m=grid.gsd_m,
        seen=counter.pixels / (lines * samples * len(bands)),
        error_px=error_px,
        vertical=ground.vertical,
        statements=gathered(
            one for one in scene.statements + ground.statements if one.subject is not Subject.BANDS
        ),
    )


def _check_request(ortho_map: OrthoMap, output: Path, inputs: Sequence[Path]) -> None:
    """Refuse a ground sampling that is none, and an output that would replace an input."""
    if ortho_map.gsd_m is not None and not ortho_map.gsd_m > 0.0:
        raise InputError(f"gsd_m: {ortho_map.gsd_m:g} found, a length above 0 m expected")
    if output.resolve() in [path.resolve() for path in inputs]:
        raise InputError(f"{output}: the output would replace an input file; choose another name")


def pixel_type(raster: SceneImage) -> tuple[str, float]:
    """The pixel type of the ortho-image of a scene, and its value for pixels without data."""
    dtype = raster.dataset.dtypes[0]
    if dtype not in _KEPT_TYPES:
        dtype = "float32"
    nodata = raster.validity.nodata[0]
    if nodata is None:
        nodata = float("nan") if dtype == "float32" else 0.0
    return dtype, float(nodata)


@dataclass
class DataPixels:
    """Counts the pixels with data of windows on their way into the file: none at all is an error.

    Attributes:
        of_none: makes that error.
        pixels: with data so far, of all bands.
    """

    of_none: Callable[[], CoverageError]
    pixels: int = 0

    def count(self, windows: Iterator[OrthoWindow]) -> Iterator[OrthoWindow]:
        """The windows, counted."""
        for window in windows:
            self.pixels += int((~np.isnan(window.pixels)).sum())
            yield window
        if self.pixels == 0:
            raise self.of_none()


def _check(connection: Connection, caller: Token, inputs: OrthorectifyScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "dem", "model", "geoid")
    if inputs.map.gsd_m is not None and not inputs.map.gsd_m > 0.0:
        raise InputError(f"map.gsd_m: {inputs.map.gsd_m:g} found, a length above 0 m expected")
    scene = scenes.find_scene(connection, inputs.scene)
    if scene is not None and scene.gsd_m is not None and inputs.map.gsd_m is not None:
        with naming("map"):
            require_warranted_gsd(inputs.map.gsd_m, scene.gsd_m)
    if inputs.map.crs is not None:
        with naming("map.crs"):
            check_map_code(inputs.map.crs)
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)
    if inputs.registration is not None:
        if inputs.model is not None:
            raise InputError("model, registration: only one of both is expected")
        registered_model_keys(connection, inputs.scene, inputs.registration)


def _run(work: Work) -> Commit:
    """Orthorectify an uploaded scene and put the ortho-image into the storage."""
    inputs: OrthorectifyScene = work.inputs
    jobs = [] if inputs.registration is None else [inputs.registration]
    with work.database.snapshot() as connection:
        [scene] = stored_scenes(connection, [inputs.scene], jobs)
        owner = work.job.owner
        room = None if owner is None else quotas.room_left(connection, work.settings, owner)
    with ExitStack() as stack:
        image, registration = local_scene(work, scene, stack)
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
        model = image.with_name(inputs.model) if inputs.model else None
        geoid = image.with_name(inputs.geoid) if inputs.geoid else None
        with suspecting_damage(work.database, work.storage, scene.keys):
            ortho = run_orthorectification(
                ImageFiles(image, model),
                TerrainFile(
                    image.with_name(inputs.dem),
                    inputs.vertical,
                    geoid,
                    inputs.fill_px,
                    is_uploaded=True,
                ),
                folder / ORTHO_NAME,
                ortho_map=inputs.map,
                options=inputs.options,
                registration=registration,
                limits=MapLimits(room),
                progress=work.progress,
            )
        stored = store_results(work, {ORTHO_NAME: ortho.path})

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "lines": ortho.lines,
            "samples": ortho.samples,
            "seen": ortho.seen,
            "error_px": ortho.error_px,
            "statements": stated_document(ortho.statements),
            "files": stored,
        }

    return commit


ORTHORECTIFY = Process(
    id="orthorectify",
    title="Orthorectify a scene",
    description="Resample an uploaded scene to a map, with its sensor model and a terrain that "
    "was uploaded with the scene.",
    scope=Scope.REGISTER,
    inputs=OrthorectifyScene,
    outputs={ORTHO_NAME: "The scene on the map, a cloud-optimised GeoTIFF."},
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the map, px"},
        "samples": {"type": "integer", "title": "Samples of the map, px"},
        "seen": {"type": "number", "title": "Share of the map's pixels with data"},
        "error_px": {"type": "number", "title": "Largest error of the mapping, px"},
        "statements": STATEMENTS_VALUE,
    },
)
