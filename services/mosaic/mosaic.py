"""A mosaic of scenes: laid out on one map, levelled, cut along seams, with steps measured."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.errors import InputError
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.mosaic.layout import Layout, MosaicScene, Rectifier, common_window, inside
from amers.services.mosaic.levelling import Levels, level, overlap_of, unchanged
from amers.services.mosaic.options import MosaicOptions
from amers.services.mosaic.seams import CellImages, Labels, choose_seams
from amers.services.mosaic.steps import SeamSteps, seam_places, seam_steps, steps_task
from amers.services.mosaic.tiles import tile_labels, tile_scenes, tile_task
from amers.services.tasks import Arrays, Work
from amers.services.terrain import Terrain
from amers.services.types import Array, FloatImage, Progress, no_progress, part_of

_DEFAULT = MosaicOptions()


@dataclass(frozen=True)
class MosaicTile:
    """A part of a mosaic.

    Attributes:
        window: of the map.
        pixels: (bands, lines, samples) float32; NaN where no scene has data, +inf where saturated.
        source: (lines, samples) uint16, number of the scene of every pixel from 1; 0 for none.
    """

    window: Window
    pixels: FloatImage
    source: np.ndarray


@dataclass(frozen=True)
class Mosaic:
    """A mosaic whose seams are chosen; `mosaic_tiles` makes its pixels.

    Attributes:
        layout: of the scenes on the map.
        levels: of their grey values, as far as they are changed.
        labels: (lines, samples) of the cells, number of the scene from 1, 0 for none.
        steps: at all seams together; None without a seam.
        pair_steps: at the seams of every pair of scenes.
        rectifier: of the scenes.
        options: of the mosaic.
        work: computes the tiles.
    """

    layout: Layout
    levels: Levels
    labels: Labels
    steps: SeamSteps | None
    pair_steps: tuple[SeamSteps, ...]
    rectifier: Rectifier
    options: MosaicOptions
    work: Work

    @property
    def grid(self) -> MapGrid:
        """Its pixels."""
        return self.layout.grid


def make_mosaic(
    layout: Layout,
    terrain: Terrain,
    options: MosaicOptions = _DEFAULT,
    *,
    work: Work | None = None,
    progress: Progress = no_progress,
) -> Mosaic:
    """Level scenes, choose the seams between them, and measure the steps there.

    Seams are chosen by levelled grey values, also where those of the mosaic stay as they are.

    Args:
        layout: of the scenes on the map.
        terrain: the ground, or a surface.
        options: of the mosaic.
        work: computes the tasks and keeps their results; by default in this process, in memory.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the scenes have different bands, or none has the name of the anchor.
    """
    work = work or Work()
    names = [one.name for one in layout.scenes]
    anchor = _anchor(names, options.anchor)
    _check_bands(layout.scenes)
    rectifier = Rectifier(layout.grid, terrain, options.ortho)
    images = _cell_images(layout, rectifier, work, part_of(progress, 0.0, 0.6))
    levels = _levels(layout, images, anchor)
    progress(0.6, "choosing seams")
    labels = choose_seams(CellImages(layout, images, levels))
    places = seam_places(labels, layout.cell_px)
    named = {pair: f"steps/{pair[0]:05d}-{pair[1]:05d}" for pair in places}
    tasks = [
        (
            named[pair],
            lambda pair=pair, at=at: (
                (layout.scenes[pair[0]], layout.scenes[pair[1]]),
                at,
                rectifier,
            ),
        )
        for pair, at in places.items()
    ]
    work.run(steps_task, tasks, part_of(progress, 0.7, 0.3))
    steps, pair_steps = seam_steps(names, {pair: work.kept[name] for pair, name in named.items()})
    kept = levels if options.level else unchanged(*levels.gain.shape)
    return Mosaic(layout, kept, labels, steps, pair_steps, rectifier, options, work)


def mosaic_tiles(mosaic: Mosaic, progress: Progress = no_progress) -> Iterator[MosaicTile]:
    """The tiles of a mosaic that scenes reach, row by row.

    Args:
        mosaic: whose seams are chosen.
        progress: receives the fraction done.
    """
    named = {f"tiles/{w.line:07d}-{w.sample:07d}": w for w in _tiles(mosaic)}
    tasks = [(name, partial(_tile_arguments, mosaic, window)) for name, window in named.items()]
    mosaic.work.run(tile_task, tasks, progress)
    for name, window in named.items():
        found = mosaic.work.kept[name]
        yield MosaicTile(window, found["pixels"], found["source"])


def _tile_arguments(mosaic: Mosaic, window: Window) -> tuple[object, ...]:
    layout = mosaic.layout
    labels = tile_labels(layout, mosaic.labels, window, mosaic.options.feather_px)
    found = tile_scenes(layout, mosaic.levels, window)
    return window, labels, found, mosaic.rectifier


def _tiles(mosaic: Mosaic) -> Iterator[Window]:
    (lines, samples), side = mosaic.grid.shape, mosaic.options.tile_px
    for line in range(0, lines, side):
        for sample in range(0, samples, side):
            window = Window(line, sample, min(side, lines - line), min(side, samples - sample))
            if mosaic.layout.reaching(window):
                yield window


def cells_task(one: MosaicScene, rectifier: Rectifier, window: Window) -> Arrays:
    """What a scene shows in cells of the map."""
    return {"pixels": rectifier.pixels(one, window)}


def _cell_images(
    layout: Layout, rectifier: Rectifier, work: Work, progress: Progress
) -> list[FloatImage]:
    """Grey values (bands, lines, samples) of every scene in its cells."""
    on_cells = replace(rectifier, grid=layout.cells)
    names = [f"cells/{number:05d}" for number in range(len(layout.scenes))]
    tasks = [
        (
            name,
            lambda number=number: (
                layout.scenes[number],
                on_cells,
                layout.cell_window(number),
            ),
        )
        for number, name in enumerate(names)
    ]
    work.run(cells_task, tasks, progress)
    return [work.kept[name]["pixels"] for name in names]


def _levels(layout: Layout, images: Sequence[FloatImage], anchor: int | None) -> Levels:
    """Gains and offsets of the scenes, from what their cells have in common."""
    overlaps = []
    for first, second in layout.overlapping():
        own = layout.cell_window(first), layout.cell_window(second)
        common = common_window(*own)
        if common is not None:
            values = [
                images[k][:, *inside(common, w)] for k, w in zip((first, second), own, strict=True)
            ]
            overlaps.append(overlap_of(first, second, np.stack(values).reshape(2, len(images[0]), -1)))
    means = np.array([_means(image) for image in images])
    return level([one for one in overlaps if one is not None], means, anchor)


def _means(image: FloatImage) -> Array:
    """Mean (bands,) of the finite values of a scene; 0 without any."""
    seen = np.isfinite(image)
    return np.asarray(
        np.where(seen, image, 0.0).sum(axis=(1, 2), dtype=np.float64)
        / np.maximum(seen.sum(axis=(1, 2)), 1)
    )


def _anchor(names: Sequence[str], anchor: str | None) -> int | None:
    if anchor is None:
        return None
    if anchor not in names:
        raise InputError(
            f"anchor: {anchor} found, the name of a scene on the map expected: {', '.join(names[:5])}"
        )
    return names.index(anchor)


def _check_bands(scenes: Sequence[MosaicScene]) -> None:
    counts = {one.name: len(one.bands) for one in scenes}
    first, *rest = counts
    for name in rest:
        if counts[name] != counts[first]:
            raise InputError(
                f"{name}: {counts[name]} bands found, {counts[first]} expected as in {first}; make one "
                "mosaic of images with the same bands"
            )
