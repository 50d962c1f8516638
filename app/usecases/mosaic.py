"""Make a mosaic of scenes in files: read them with their models, write pixels, sources and seams."""

import hashlib
import math
import pickle
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from amers.app.errors import InputError
from amers.app.usecases.executors import open_executor
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.mosaic_scenes import (
    MosaicFiles,
    MosaicSource,
    ReadScene,
    read_mosaic_scenes,
    sources_of,
)
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.errors import CoverageError
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.pieces import paths_of
from amers.services.formats.vector.seam_layer import write_seam_layer
from amers.services.formats.work_folder import WorkFolder
from amers.services.imagery.scene import scene_footprint
from amers.services.mosaic.layout import Layout, MosaicMap, flat_terrain, lay_out
from amers.services.mosaic.mosaic import Mosaic, MosaicTile, make_mosaic, mosaic_tiles
from amers.services.mosaic.options import MosaicOptions
from amers.services.mosaic.steps import SeamSteps, StepFigures
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.sensors.ortho import OrthoModel
from amers.services.statements import Statements, Subject, gathered
from amers.services.tasks import Effort, Work
from amers.services.terrain import Terrain
from amers.services.types import Array, Progress, no_progress, part_of

MOST_SCENES = 30_000
"""Largest number of scenes: cells have 16-bit numbers."""


@dataclass(frozen=True)
class MosaicGround:
    """The ground of a mosaic.

    Attributes:
        terrain: heights of the ground, or a surface; None takes `height_m` everywhere.
        height_m: height of flat ground above the ellipsoid, metres; replaces --dem. Images on a map need
            neither.
    """

    terrain: TerrainFile | None = None
    height_m: float | None = None


@dataclass(frozen=True)
class MosaicFile:
    """A mosaic that was written.

    Attributes:
        path: of the pixels, a cloud-optimised GeoTIFF.
        sources: of the image with the number of the scene of each pixel, from 1; 0 where none has data.
        seams: of the GeoPackage with the ground that each scene shows.
        crs: of the map.
        lines, samples, bands: its size.
        gsd_m: ground sampling, metres.
        seen: share of its pixels that have data.
        scenes: of every scene its number, name, share of the pixels that have data, and gain and offset
            by band.
        left_out: names of the scenes outside the map.
        seam_step: steps at all seams together, in metres; None without a seam.
        pairs: steps at the seams of every pair of scenes.
        vertical: how the vertical datum of the ground is known.
        effort: what every stage took.
        statements: of the files.
    """

    path: Path
    sources: Path
    seams: Path
    crs: str
    lines: int
    samples: int
    bands: int
    gsd_m: float
    seen: float
    scenes: tuple[dict[str, Any], ...]
    left_out: tuple[str, ...]
    seam_step: dict[str, Any] | None
    pairs: tuple[dict[str, Any], ...]
    vertical: str
    effort: dict[str, Effort] = field(default_factory=dict)
    statements: Statements = ()

    def __repr__(self) -> str:
        lines = [
            f"MosaicFile {self.path}: {self.crs}",
            f"  {self.lines} x {self.samples} pixels of {self.gsd_m:.2f} m, {self.bands} bands, "
            f"{100.0 * self.seen:.0f} % with data, from {len(self.scenes)} scenes",
        ]
        if self.seam_step is not None:
            lines.append(f"  steps at seams: {step_words(self.seam_step)}")
        return "\n".join(lines)


def run_mosaic(
    files: MosaicFiles,
    ground: MosaicGround,
    output: Path,
    options: MosaicOptions,
    *,
    wanted: MosaicMap,
    place: WorkPlace,
    progress: Progress = no_progress,
) -> MosaicFile:
    """Make a mosaic; write `output`, beside it `NAME.sources.tif` and `NAME.seams.gpkg`.

    Args:
        files: of the scenes.
        ground: that they are rectified on.
        output: GeoTIFF; existing files are replaced when the new ones are complete.
        options: of the mosaic.
        wanted: map.
        place: where the work is done. Without a folder of its own, results of tasks are kept next to the
            output until the files are complete, so that an interrupted work continues.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used, or the images have different bands or types.
        CoverageError: no scene reaches the map.
    """
    sources = sources_of(files)
    return write_mosaic(sources, ground, output, options, wanted=wanted, place=place, progress=progress)


def write_mosaic(
    images: Sequence[MosaicSource],
    ground: MosaicGround,
    output: Path,
    options: MosaicOptions,
    *,
    wanted: MosaicMap,
    place: WorkPlace,
    check: Callable[[Layout, BandForm], None] = lambda _layout, _form: None,
    progress: Progress = no_progress,
) -> MosaicFile:
    """Make a mosaic of images whose models come from anywhere; see `run_mosaic`.

    Args:
        images: with their models.
        ground, output, options, wanted, place, progress: as `run_mosaic` takes them.
        check: refuses a map that may not be made.

    Raises:
        InputError: a file cannot be used, or the images have different bands or types.
        CoverageError: no scene reaches the map.
    """
    _check(images, output)
    read, outside = _near(read_mosaic_scenes(images), wanted.outline)
    terrain = _terrain(ground, read)
    layout = lay_out([one.scene for one in read], terrain, wanted)
    layout = replace(layout, left_out=(*outside, *layout.left_out))
    form = read[0].form
    check(layout, form)
    with ExitStack() as stack:
        folder = place.folder or output.with_name(f"{output.name}.work")
        kept = WorkFolder(folder, _inputs(read, ground, options, wanted), place.most_bytes)
        executor, ahead = stack.enter_context(open_executor(place.compute))
        work = Work(executor, kept, ahead)
        mosaic = make_mosaic(layout, terrain, options, work=work, progress=part_of(progress, 0.0, 0.5))
        counter = _Shown(np.zeros(len(layout.scenes) + 1, dtype=np.int64))
        tiles = counter.count(mosaic_tiles(mosaic, part_of(progress, 0.5, 0.4)))
        write_cog(output, mosaic.grid, _pixels(tiles), form)
        if not counter.pixels[1:].any():
            output.unlink()
            raise CoverageError("no pixel of the map shows a scene; check the terrain and its datum")
        sources = output.with_name(f"{output.stem}.sources.tif")
        numbers = BandForm(1, "uint16", 0.0, names=("scene",), units=("",), overviews="NEAREST")
        write_cog(sources, mosaic.grid, _numbers(mosaic_tiles(mosaic)), numbers)
        seams = output.with_name(f"{output.stem}.seams.gpkg")
        write_seam_layer(seams, sources, layout.cell_px, _fields(mosaic))
    if place.folder is None:
        shutil.rmtree(folder)
    progress(1.0, "written")
    lines, samples = mosaic.grid.shape
    return MosaicFile(
        output,
        sources,
        seams,
        wanted.crs or mosaic.grid.crs,
        lines,
        samples,
        form.bands,
        mosaic.grid.gsd_m,
        float(counter.pixels[1:].sum()) / (lines * samples),
        tuple(_scene_rows(mosaic, counter.pixels[1:])),
        layout.left_out,
        None if mosaic.steps is None else _step_row(mosaic.steps),
        tuple({"scenes": list(one.scenes), **_step_row(one)} for one in mosaic.pair_steps),
        terrain.vertical,
        dict(work.effort),
        gathered(
            statement
            for statement in (*(s for one in read for s in one.statements), *terrain.statements)
            if statement.subject is not Subject.BANDS
        ),
    )


def step_words(step: dict[str, Any]) -> str:
    """Steps at seams in words."""

    def words(of: dict[str, Any]) -> str:
        if not of["found"]:
            return "none measured"
        return f"median {of['median_m']:.2f} m, 90 % below {of['p90_m']:.2f} m"

    text = f"{words(step)} ({step['found']} of {step['places']} places)"
    if step["delivered"] is not None:
        found = step["delivered"]["found"]
        text += f"; with the delivered models {words(step['delivered'])} ({found})"
    return text


def box_outline(west: float, south: float, east: float, north: float) -> Array:
    """Continuous positions (n, 2) along the border of a box; one with east below west crosses 180."""
    east += 360.0 if east < west else 0.0
    t = np.linspace(0.0, 1.0, 17)
    along, up = west + t * (east - west), south + t * (north - south)
    ends = [np.full(len(t), value) for value in (west, south, east, north)]
    sides = [(along, ends[1]), (ends[2], up), (along[::-1], ends[3]), (ends[0], up[::-1])]
    return np.concatenate([np.column_stack(side) for side in sides])


def _check(images: Sequence[MosaicSource], output: Path) -> None:
    if not 1 <= len(images) <= MOST_SCENES:
        raise InputError(f"{len(images)} images found, 1 to {MOST_SCENES:,} expected")
    if output.resolve() in [one.image.resolve() for one in images]:
        raise InputError(f"{output}: the output would replace an image; choose another name")


def _near(read: Sequence[ReadScene], outline: Array | None) -> tuple[list[ReadScene], tuple[str, ...]]:
    """The scenes that may show an outline, and the names of the others.

    Raises:
        CoverageError: none does.
    """
    if outline is None:
        return list(read), ()
    area = shapely.Polygon(outline)
    near, outside = [], []
    for one in read:
        footprint = scene_footprint(one.scene.scene)
        footprint[:, 0] += 360.0 * np.round((outline[0, 0] - footprint[0, 0]) / 360.0)
        if shapely.Polygon(footprint).intersects(area):
            near.append(one)
        else:
            outside.append(one.scene.name)
    if not near:
        raise CoverageError(f"no scene reaches the box ({', '.join(outside[:5])}); check --bbox")
    return near, tuple(outside)


def _terrain(ground: MosaicGround, read: Sequence[ReadScene]) -> Terrain:
    if ground.terrain is not None and ground.height_m is not None:
        raise InputError("heights of the ground: either --dem or --height-m is expected, not both")
    if ground.terrain is not None:
        return read_terrain(ground.terrain)
    if ground.height_m is not None:
        return flat_terrain(ground.height_m)
    needing = [one for one in read if not isinstance(one.scene.scene.model, OrthoModel)]
    if needing:
        raise InputError(
            f"{needing[0].scene.name}: the image is no ortho-image, so heights of the ground are "
            "needed; give a terrain or surface (--dem), or one height above the ellipsoid (--height-m)"
        )
    return flat_terrain(0.0)


def _inputs(
    read: Sequence[ReadScene], ground: MosaicGround, options: MosaicOptions, wanted: MosaicMap
) -> dict[str, Any]:
    """What the results of all tasks depend on; the size of the tiles is part of it."""
    outline = None if wanted.outline is None else wanted.outline.tolist()
    dem = None if ground.terrain is None else ground.terrain.dem
    return {
        "version": version("amers"),
        "images": [
            {**_fact(one.path), "models": _digest((one.scene.scene.model, one.scene.delivered))}
            for one in read
        ],
        "ground": {
            **asdict(ground),
            **({} if dem is None else {"dem": [_fact(path) for path in paths_of(dem)]}),
        },
        "options": asdict(options),
        "map": [wanted.crs, wanted.gsd_m, outline],
    }


def _digest(value: object) -> str:
    return hashlib.sha256(pickle.dumps(value)).hexdigest()


def _fact(path: Path) -> dict[str, Any]:
    fact = path.stat()
    return {"file": str(path.resolve()), "bytes": fact.st_size, "modified": fact.st_mtime_ns}


@dataclass
class _Shown:
    """Counts the pixels of every scene in tiles on their way into the file."""

    pixels: np.ndarray

    def count(self, tiles: Iterator[MosaicTile]) -> Iterator[MosaicTile]:
        for tile in tiles:
            self.pixels += np.bincount(tile.source.ravel(), minlength=len(self.pixels))
            yield tile


def _pixels(tiles: Iterator[MosaicTile]) -> Iterator[OrthoWindow]:
    for tile in tiles:
        yield OrthoWindow(tile.window, tile.pixels, 0.0)


def _numbers(tiles: Iterator[MosaicTile]) -> Iterator[OrthoWindow]:
    for tile in tiles:
        numbers = tile.source[None].astype(np.float32)
        numbers[numbers == 0.0] = np.nan
        yield OrthoWindow(tile.window, numbers, 0.0)


def _fields(mosaic: Mosaic) -> dict[str, np.ndarray]:
    """Attributes of the seam layer."""
    scenes = [one.scene for one in mosaic.layout.scenes]
    times = [one.acquisition.acquired_at for one in scenes]
    return {
        "scene": np.array([one.name for one in mosaic.layout.scenes], dtype=object),
        "sensor": np.array([one.acquisition.sensor for one in scenes], dtype=object),
        "acquired_at": np.array([None if t is None else t.isoformat() for t in times], dtype=object),
        "sigma_m": np.array([one.sigma_m for one in mosaic.layout.scenes], dtype=np.float64),
    }


def _scene_rows(mosaic: Mosaic, pixels: np.ndarray) -> Iterator[dict[str, Any]]:
    total = int(pixels.sum())
    for number, (one, count) in enumerate(zip(mosaic.layout.scenes, pixels.tolist(), strict=True)):
        yield {
            "number": number + 1,
            "scene": one.name,
            "acquired_at": one.scene.acquisition.acquired_at,
            "sigma_m": None if math.isnan(one.sigma_m) else round(one.sigma_m, 3),
            "share": round(count / total, 4),
            "gain": [round(float(v), 4) for v in mosaic.levels.gain[number]],
            "offset": [round(float(v), 3) for v in mosaic.levels.offset[number]],
        }


def _step_row(steps: SeamSteps) -> dict[str, Any]:
    delivered = None if steps.delivered is None else _figures(steps.delivered)
    return {"places": steps.places, **_figures(steps.used), "delivered": delivered}


def _figures(figures: StepFigures) -> dict[str, Any]:
    values = asdict(figures)
    return {
        k: None if isinstance(v, float) and math.isnan(v) else round(v, 3) for k, v in values.items()
    }
