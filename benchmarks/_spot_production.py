"""A block produced from two products of SPOT 2, and the true errors of its points."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.geodesy import move_metres
from amers.services.imagery.source import ArrayImage, render_chip
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.types import Array, ChipArray, Observations
from benchmarks._continent_points import PointVerdict, TruePlaces, judge_points
from benchmarks._spot import GSD_M, run

_SEARCH_PX = 40
"""Pixels around the middle of a chip in which its place is searched: 400 m, more than models are off."""
_SAME_PIXELS = CorrelationOptions(min_score=0.9, max_second=0.97, max_sigma_px=2.0)

Rendered = tuple[ArrayImage, PushbroomModel]
"""The rendered part of a product, and its true model."""


def produce(images: Sequence[Path], control: Sequence[object], output: Path) -> Path:
    """The block that is produced from products by their delivered names."""
    given = [word for image in images for word in ("--images", image)]
    sampling = ["--gsd-m", f"{GSD_M:g},{2.0 * GSD_M:g}"]
    run("production", "run", *given, *sampling, *control, "-o", output)
    return output


def judged_block(folder: Path, products: Mapping[str, Rendered]) -> PointVerdict:
    """The true errors of the points of a block against what it declares.

    The middle of a chip shows the point. It is found again in the image of the chip, and the true lines
    of sight of all these positions intersect at the true point.

    Args:
        folder: of the block.
        products: by the names that the images have in the block.
    """
    points, chips = read_block(folder).points, FolderChips(folder)
    views, images = points.views, [products[image.image_id] for image in points.views.images]
    seen: list[tuple[int, int, Array]] = []
    for row in range(len(points)):
        first, last = views.start[row : row + 2].tolist()
        fine = np.flatnonzero(views.gsd_m[first:last] == views.gsd_m[first:last].min())
        stored = chips.read(
            points.chip_files[points.chip_file[row]], int(points.chip_row[row]), last - first
        )
        for k in fine.tolist():
            number = int(views.image[first + k])
            position = _found(stored[k], images[number], points.lon_lat_h[row], views.gsd_m[first + k])
            if position is not None:
                seen.append((row, number, position))
    chips.close()
    observed = Observations(
        np.array([row for row, _, _ in seen], dtype=np.int64),
        np.array([number for _, number, _ in seen], dtype=np.int64),
        np.array([position for _, _, position in seen]).reshape(-1, 2),
        np.ones(len(seen)),
    )
    true = intersect([model for _, model in images], observed, len(points)).lon_lat_h
    return judge_points(points, TruePlaces(true, np.full(len(points), np.nan)))


def _found(stored: ChipArray, image: Rendered, ground: Array, gsd_m: float) -> Array | None:
    """Position (2,) of the middle of a chip in the part of its image; None where it is not found."""
    pixels, model = image
    chip = np.where(stored == 0, np.nan, stored).astype(np.float32)
    patch = render_chip(pixels, model, ground, gsd_m, len(chip) + 2 * _SEARCH_PX)
    peak = find_chip(patch, chip, _SAME_PIXELS)
    if peak.reason != FOUND:
        return None
    moved_m = np.array([[peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m, 0.0]])
    return np.asarray(model.project(move_metres(ground[None, :], moved_m))[0])
