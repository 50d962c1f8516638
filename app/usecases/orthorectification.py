"""Laying a scene on a map through its model and a terrain."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np

from app.auth import Scope
from app.db import registrations
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import InputError
from app.usecases.processes import Commit, Process, Work
from app.usecases.scene_inputs import check_file_names, check_scene, present_scene
from app.usecases.scenes import local_image
from services.formats.elevation.dem import read_dem
from services.formats.images.bands import one_band
from services.formats.images.ortho import write_cog
from services.formats.images.raster import RasterImage
from services.formats.images.scenes import read_scene
from services.orthorectification.rectify import OrthoOptions, OrthoWindow, choose_grid, orthorectify
from services.types import Progress, no_progress

ORTHO_NAME = "ortho.tif"
REFINED_NAME = "refined_RPC.TXT"
"""As a registration calls its refined model."""
_KEPT_TYPES = ("uint8", "uint16", "int16", "float32")


@dataclass(frozen=True)
class TerrainFile:
    """A terrain on the disk.

    Attributes:
        dem: heights on a map.
        vertical: what they are counted from, when the file does not say; see `read_dem`.
        geoid: grid file of the geoid, if PROJ has none.
        fill_px: voids are filled from heights at most so many nodes away.
    """

    dem: Path
    vertical: str | None = None
    geoid: Path | None = None
    fill_px: int = 0


@dataclass(frozen=True)
class OrthoMap:
    """The map that is made.

    Attributes:
        crs: reference system; by default the UTM zone of the centre.
        gsd_m: ground sampling; by default that of the scene.
    """

    crs: str | None = None
    gsd_m: float | None = None


@dataclass(frozen=True)
class Orthorectified:
    """What was made.

    Attributes:
        path: of the image.
        crs: of its map.
        lines, samples, bands: its size.
        gsd_m: ground sampling.
        seen: share of its pixels that show something.
        error_px: largest difference from the scene's model where the mapping was checked.
        vertical: how the vertical datum of the terrain is known.
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


@dataclass(frozen=True)
class OrthorectifyScene:
    """What a user says to have a scene rectified.

    Attributes:
        scene: id of an uploaded scene.
        dem: name of the file with the terrain that was uploaded beside its image.
        model: name of the uploaded file with its model; by default it is found.
        registration: job that registered the scene, whose refined model is then followed.
        vertical: what the heights are counted from, when the file does not say.
        geoid: name of an uploaded grid file of the geoid.
        fill_px: voids are filled from heights at most so many nodes away.
        map: that is made.
        options: of the rectification.
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


_SAME = OrthoMap()
_USUAL = OrthoOptions()


def run_orthorectification(
    image: Path,
    model: Path | None,
    terrain: TerrainFile,
    output: Path,
    ortho_map: OrthoMap = _SAME,
    options: OrthoOptions = _USUAL,
    progress: Progress = no_progress,
) -> Orthorectified:
    """Write a scene as a cloud-optimised GeoTIFF on a map, with all its bands.

    Pixels keep their type where that is 8 or 16 bits or real; else they become real.

    Args:
        image: of the scene.
        model: file of its model, if it is not found by itself.
        terrain: the ground.
        output: a file of that name is replaced.
        ortho_map: that is made.
        options: how.
        progress: told where the work stands.

    Raises:
        InputError: the scene or the terrain cannot be used.
        ComputationError: the model cannot be followed within the tolerance.
    """
    if ortho_map.gsd_m is not None and not ortho_map.gsd_m > 0.0:
        raise InputError(f"gsd_m: {ortho_map.gsd_m:g} given, more than 0 expected")
    if output.resolve() in (image.resolve(), terrain.dem.resolve()):
        raise InputError(f"{output}: what was delivered would be written over")
    scene = read_scene(image, model, sigma_m=1.0)
    first = scene.image
    assert isinstance(first, RasterImage)
    ground = read_dem(terrain.dem, terrain.vertical, terrain.geoid, terrain.fill_px)
    bands = [replace(first, mix=one_band(band)) for band in _data_bands(first)]
    grid = choose_grid(scene, ground, ortho_map.crs, ortho_map.gsd_m)
    dtype = first.dataset.dtypes[0]
    dtype = dtype if dtype in _KEPT_TYPES else "float32"
    nodata = first.dataset.nodata
    if nodata is None:
        nodata = float("nan") if dtype == "float32" else 0.0
    seen = _Counted()
    windows = seen.counted(orthorectify(bands, scene.model, ground, grid, options, progress=progress))
    error_px = write_cog(output, grid, windows, len(bands), dtype, float(nodata))
    share = seen.pixels / (grid.shape[0] * grid.shape[1] * len(bands))
    gsd_m = float(abs(np.linalg.det(grid.step_xy))) ** 0.5
    if grid.is_geographic:
        gsd_m *= 111_320.0
    first.close()
    return Orthorectified(
        output,
        ortho_map.crs or grid.crs,
        *grid.shape,
        len(bands),
        gsd_m,
        share,
        error_px,
        ground.vertical,
    )


@dataclass
class _Counted:
    """Counts the pixels that show something, on their way into the file."""

    pixels: int = 0

    def counted(self, windows: Iterator[OrthoWindow]) -> Iterator[OrthoWindow]:
        for done in windows:
            self.pixels += int(np.isfinite(done.pixels).sum())
            yield done


def _data_bands(image: RasterImage) -> list[int]:
    """The bands that are not a mask of the others."""
    colours = [colour.name for colour in image.dataset.colorinterp]
    return [band for band, colour in enumerate(colours, start=1) if colour != "alpha"]


def _check(connection: Connection, caller: Token, inputs: OrthorectifyScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "dem", "model", "geoid")
    if inputs.registration is not None:
        if inputs.model is not None:
            raise InputError("model and registration exclude each other")
        _refined_key(connection, inputs.scene, inputs.registration)


def _refined_key(connection: Connection, scene_id: UUID, job_id: UUID) -> str:
    """Where the storage has the refined model that a job left of a scene.

    Raises:
        InputError: the job did not register the scene, or left no RPC.
    """
    found = registrations.find_by_job(connection, job_id)
    if found is None or found.scene_id != scene_id:
        raise InputError(f"registration: job {job_id} did not register scene {scene_id}")
    key = found.files.get(REFINED_NAME)
    if key is None:
        raise InputError(f"registration: job {job_id} left no {REFINED_NAME}: no RPC fits its model")
    return key


def _run(work: Work) -> Commit:
    """Rectify an uploaded scene; the image is in the storage before the job says so."""
    inputs: OrthorectifyScene = work.inputs
    with work.database.transaction() as connection:
        scene = present_scene(connection, inputs.scene)
        asked = inputs.registration
        refined = None if asked is None else _refined_key(connection, inputs.scene, asked)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        model = image.with_name(inputs.model) if inputs.model else None
        if refined is not None:
            model = work.storage.fetch(refined, Path(folder))
        made = run_orthorectification(
            image,
            model,
            TerrainFile(
                image.with_name(inputs.dem),
                inputs.vertical,
                image.with_name(inputs.geoid) if inputs.geoid else None,
                inputs.fill_px,
            ),
            Path(folder) / ORTHO_NAME,
            inputs.map,
            inputs.options,
            work.progress,
        )
        key = work.storage.put_file(f"{work.attempt_folder}/{ORTHO_NAME}", made.path).key

    def commit(connection: Connection) -> dict[str, Any]:
        said = {"lines": made.lines, "samples": made.samples, "seen": made.seen}
        return {**said, "error_px": made.error_px, "files": {ORTHO_NAME: key}}

    return commit


ORTHORECTIFY = Process(
    id="orthorectify",
    title="Rectify a scene",
    description="Lay an uploaded scene on a map through its model and a terrain uploaded beside it.",
    scope=Scope.REGISTER,
    inputs=OrthorectifyScene,
    outputs={ORTHO_NAME: "The scene on the map, a cloud-optimised GeoTIFF."},
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the map, px"},
        "samples": {"type": "integer", "title": "Samples of the map, px"},
        "seen": {"type": "number", "title": "Share of the map that the scene shows"},
        "error_px": {"type": "number", "title": "Largest error of the mapping, px"},
    },
)
