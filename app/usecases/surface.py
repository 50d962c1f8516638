"""Make a surface from scenes: read those in files with their refined models, write a GeoTIFF."""

import hashlib
import pickle
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.executors import open_executor
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.registered_scene import SceneModel, adjusted_model, read_registered_scene
from amers.app.usecases.report_files import write_texts
from amers.services.datums import horizontal
from amers.services.formats.ground_masks import ExcludedGround, any_of, read_ground_mask
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.formats.images.surfaces import BANDS, heights_crs, read_reduced
from amers.services.formats.work_folder import WorkFolder
from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.reports.html import format_html
from amers.services.reports.surface import SHOWN_CELLS, ReducedMap, SurfaceReport, UsedPair
from amers.services.reports.surface_pages import SURFACE_PAGE
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.statements import Statements, gathered
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.surface import Surface, SurfaceTile, make_surface, surface_tiles
from amers.services.tasks import Effort, Work
from amers.services.types import Progress, no_progress, part_of


@dataclass(frozen=True)
class SurfaceFiles:
    """The files that a surface is made from.

    Attributes:
        images: two or more images of the same ground.
        registered: output folder of `amers scene register-many`, with the registrations of the images.
        block: folder of a block that was made from the images; the adjusted models of the block are
            used.
        water: water, which is the stated reason for empty cells there: polygons in GeoJSON, or an image
            on a map that is not 0 there; repeat for several.
    """

    images: tuple[Path, ...]
    registered: Path | None = None
    block: Path | None = None
    water: tuple[Path, ...] = ()


@dataclass(frozen=True)
class SurfaceScene:
    """A scene that a surface is made from.

    Attributes:
        scene: with the model to use, open.
        name: of it, among the scenes of the surface.
        image: what tells its image from others, as JSON.
    """

    scene: Scene
    name: str
    image: Mapping[str, Any]


@dataclass(frozen=True)
class SurfaceFile:
    """A surface that was written.

    Attributes:
        path: of the GeoTIFF.
        report: page that shows it, beside it.
        crs: of its map, with heights above the ellipsoid.
        lines, samples: its size.
        gsd_m: side of a cell, metres.
        pairs: what it was made of: names of the images, base over height, shift onto the others (x, y,
            height in metres), and noise of the heights in metres.
        cells: number of cells by why they have no height, or that they have one.
        sigma_m: median of the standard deviations of the heights.
        effort: what every stage took.
        statements: of the files of the scenes.
    """

    path: Path
    report: Path
    crs: str
    lines: int
    samples: int
    gsd_m: float
    pairs: tuple[dict[str, Any], ...]
    cells: dict[str, int]
    sigma_m: float
    effort: dict[str, Effort] = field(default_factory=dict)
    statements: Statements = ()

    def __repr__(self) -> str:
        share = self.cells.get(REASON_LABELS[Reason.FOUND], 0) / (self.lines * self.samples)
        return (
            f"SurfaceFile {self.path}: {self.crs}\n"
            f"  {self.lines} x {self.samples} cells of {self.gsd_m:.2f} m, {100.0 * share:.0f} % with a "
            f"height, from {len(self.pairs)} pairs of images\n"
            f"  sigma of the heights: {self.sigma_m:.2f} m (median)"
        )


def run_surface(
    files: SurfaceFiles,
    output: Path,
    options: SurfaceOptions,
    *,
    place: WorkPlace,
    progress: Progress = no_progress,
) -> SurfaceFile:
    """Make a surface and write it as a cloud-optimised GeoTIFF with the bands of `BANDS`.

    Args:
        files: of the scenes.
        output: the file; an existing one is replaced when the new one is complete. A page that shows it,
            of the same name with the ending html, is written beside it.
        options: of the surface.
        place: where the work is done. Without a folder of its own, results of tasks are kept next to the
            output until the file is complete, so that an interrupted work continues.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used.
        CoverageError: the scenes do not show the same ground, or nothing of it was matched.
    """
    check_images(files.images, output)
    with ExitStack() as stack:
        scenes = [_scene(image, files, stack) for image in files.images]
        named = [scene_of_file(scene, image) for scene, image in zip(scenes, files.images, strict=True)]
        water = [read_ground_mask(path) for path in files.water]
        return write_surface(named, output, options, water=water, place=place, progress=progress)


def check_images(images: Sequence[Path], output: Path) -> None:
    """Refuse fewer than two images, and an output that would replace one.

    Raises:
        InputError: the message says which.
    """
    if len(images) < 2:
        raise InputError(f"{len(images)} image found; a surface needs two or more of the same ground")
    if output.resolve() in [path.resolve() for path in images]:
        raise InputError(f"{output}: the output would replace an image; choose another name")


def write_surface(
    scenes: Sequence[SurfaceScene],
    output: Path,
    options: SurfaceOptions,
    *,
    grid: MapGrid | None = None,
    water: Sequence[ExcludedGround] = (),
    place: WorkPlace,
    progress: Progress = no_progress,
) -> SurfaceFile:
    """Make the surface of open scenes; see `run_surface`.

    Args:
        scenes: two or more.
        output, options, place, progress: as `run_surface` takes them.
        grid: of the surface; see `make_surface`.
        water: what empty cells there say.

    Raises:
        CoverageError: the scenes do not show the same ground, or nothing of it was matched.
    """
    opened = [one.scene for one in scenes]
    folder = place.folder or output.with_name(f"{output.name}.work")
    kept = WorkFolder(folder, surface_inputs(scenes, options), place.most_bytes)
    with open_executor(place.compute) as (executor, ahead):
        work = Work(executor, kept, ahead)
        surface = make_surface(
            opened, options, grid=grid, work=work, progress=part_of(progress, 0.0, 0.85)
        )
        counter = _Cells()
        fused = surface_tiles(surface, part_of(progress, 0.85, 0.15), any_of([*water]))
        tiles = counter.count(fused)
        crs = heights_crs(surface.grid)
        write_cog(
            output,
            MapGrid(crs, surface.grid.origin_xy, surface.grid.step_xy, surface.grid.shape),
            _windows(tiles),
            BandForm(
                len(BANDS),
                "float32",
                float("nan"),
                names=BANDS,
                units=("metre", "metre", "", ""),
                overviews="NEAREST",
            ),
        )
    if place.folder is None:
        shutil.rmtree(folder)
    lines, samples = surface.grid.shape
    written = SurfaceFile(
        output,
        output.with_suffix(".html"),
        surface.grid.crs,
        lines,
        samples,
        float(surface.grid.step_xy[0, 1]),
        tuple(_pairs(surface, [one.name for one in scenes])),
        counter.by_label(lines * samples),
        counter.median_sigma_m,
        dict(work.effort),
        gathered(chain(*(one.statements for one in opened), *(one.statements for one in water))),
    )
    _write_report(written)
    return written


def reduced_map(path: Path, shape: tuple[int, int], gsd_m: float) -> ReducedMap:
    """A map in a file as its report shows it."""
    return ReducedMap(path.name, shape, gsd_m, *read_reduced(path, SHOWN_CELLS))


def _write_report(surface: SurfaceFile) -> None:
    report = SurfaceReport(
        reduced_map(surface.path, (surface.lines, surface.samples), surface.gsd_m),
        horizontal(surface.crs).name,
        tuple(UsedPair(**pair) for pair in surface.pairs),
        surface.cells,
        surface.sigma_m,
        surface.statements,
        datetime.now(UTC),
        version("amers"),
    )
    write_texts(surface.report.parent, {surface.report.name: format_html(SURFACE_PAGE, report)})


@dataclass
class _Cells:
    """Counts the cells of tiles on their way into the file."""

    reasons: np.ndarray = field(default_factory=lambda: np.zeros(len(Reason), dtype=np.int64))
    sigmas_m: list[float] = field(default_factory=list)

    def count(self, tiles: Iterator[SurfaceTile]) -> Iterator[SurfaceTile]:
        for tile in tiles:
            self.reasons += np.bincount(tile.reason.ravel(), minlength=len(Reason))
            known = tile.sigma_m[np.isfinite(tile.sigma_m)]
            if len(known):
                self.sigmas_m.append(float(np.median(known)))
            yield tile

    @property
    def median_sigma_m(self) -> float:
        """Median of the medians of the tiles; NaN without any height."""
        return float(np.median(self.sigmas_m)) if self.sigmas_m else float("nan")

    def by_label(self, n_cells: int) -> dict[str, int]:
        """Number of cells by reason; those of no tile are outside of what was matched."""
        self.reasons[Reason.OUTSIDE] += n_cells - int(self.reasons.sum())
        counts = zip(Reason, self.reasons.tolist(), strict=True)
        return {REASON_LABELS[reason]: count for reason, count in counts if count}


def _windows(tiles: Iterator[SurfaceTile]) -> Iterator[OrthoWindow]:
    for tile in tiles:
        bands = (tile.height_m, tile.sigma_m, tile.views, tile.reason)
        yield OrthoWindow(tile.window, np.stack(bands).astype(np.float32), 0.0)


def _scene(image: Path, files: SurfaceFiles, stack: ExitStack) -> Scene:
    """A scene with its refined model, open until the stack closes."""
    if files.registered is not None:
        registration = files.registered / scene_name(image)
        scene, _ = read_registered_scene(SceneModel(image, registration=registration))
    elif files.block is not None:
        scene = read_scene(image, adjusted_model(files.block, image), sigma_m=1.0)
    else:
        scene = read_scene(image, sigma_m=1.0)
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    refuse_ortho_image(scene, str(image))
    return scene


def refuse_ortho_image(scene: Scene, image: str) -> None:
    """Refuse a scene that has no parallax.

    Raises:
        InputError: its model is a map grid.
    """
    model = scene.model.base if isinstance(scene.model, CorrectedModel) else scene.model
    if isinstance(model, OrthoModel):
        raise InputError(
            f"{image}: an ortho-image on a map found, which has no parallax; an image with a sensor "
            "model is expected"
        )


def scene_of_file(scene: Scene, image: Path) -> SurfaceScene:
    """A scene whose image is a file, told from others by its path, size and time."""
    fact = image.stat()
    facts = {"file": str(image.resolve()), "bytes": fact.st_size, "modified": fact.st_mtime_ns}
    return SurfaceScene(scene, scene.acquisition.image_id, facts)


def surface_inputs(scenes: Sequence[SurfaceScene], options: SurfaceOptions) -> dict[str, Any]:
    """What the results of all tasks depend on."""
    return {
        "version": version("amers"),
        "images": [
            {**one.image, "model": hashlib.sha256(pickle.dumps(one.scene.model)).hexdigest()}
            for one in scenes
        ],
        "options": asdict(options),
    }


def _pairs(surface: Surface, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    for pair, shift_m, sigma_m in zip(surface.pairs, surface.shift_m, surface.sigma_m, strict=True):
        yield {
            "images": [names[pair.first], names[pair.second]],
            "base_to_height": round(pair.base_to_height, 3),
            "shift_m": [round(float(value), 3) for value in shift_m],
            "sigma_m": round(float(sigma_m), 3),
        }
