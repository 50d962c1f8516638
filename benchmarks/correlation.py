"""A chip of 101 px in a window of 181 px: `find_chip` compared with loops over `cv2.matchTemplate`.

The loops compute the normalised correlation (TM_CCOEFF_NORMED) and take the place of the largest value,
or the top of a parabola along each axis. `find_chip` also returns a sigma, and the reason when it
rejects its peak. All use the same chips and windows of a simulated ground, rendered at 1 m from images
of 0.5 m. The windows are centred up to 35 px away from the place of the chip, by fractions of a pixel,
so that the true displacement is known. Cases: another image with the same light (only the noise
differs), another day with the same direction of view (light, shadows and fields differ), and windows
that do not show the chip, where every answer is wrong.

The second table is the time of `match_points` for a point, with the rendering of the scene into the
geometry of its two chips, from memory and from a compressed file. All times are CPU times of one thread,
medians of runs taken in turn.
Run: python -m benchmarks.correlation
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from amers.services.conventions import CHIP_SIZE
from amers.services.formats.images.raster import open_raster, write_raster
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, render_chip
from amers.services.matching.control_points import ChipSearch, MatchingOptions, chip_pixels, match_points
from amers.services.matching.correlate import FOUND, CorrelationOptions, Peak, find_chip
from amers.services.simulation.view import SimulatedView, ViewPlan, simulate_view, true_ground
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, ChipArray, ControlPoints, FloatImage
from benchmarks._measuring import cpu_medians_s, keep
from benchmarks._simulated import lay_points

RADIUS_PX = 40
FARTHEST_PX = 35.0
GSD_M = 1.0
IMAGE_GSD_M = 0.5
SIDE_PX = 1_800
JUNE = datetime(2024, 6, 12, 10, 40, tzinfo=UTC)
JULY = datetime(2024, 7, 18, 10, 10, tzinfo=UTC)
OPTIONS = CorrelationOptions()


@dataclass(frozen=True)
class Pair:
    """A chip, a window, and the place of the chip in the window.

    Attributes:
        row_col: (2,) true displacement from the centre of the window; NaN where the window does not
            show the chip.
    """

    chip: FloatImage
    patch: FloatImage
    row_col: Array


@dataclass(frozen=True)
class Outcome:
    """The result of one algorithm on the pairs of one case; errors are those of the accepted peaks."""

    case: str
    way: str
    pairs: int
    accepted: int
    cpu_ms: float
    median_error_px: float | None
    largest_error_px: float | None
    error_over_sigma: float | None
    rejected: str


@dataclass(frozen=True)
class PointOutcome:
    """The CPU time of a point, or of a part of its search."""

    what: str
    cpu_ms: float


@dataclass(frozen=True)
class MemoryChips:
    """The chips of points, row after row as in one file."""

    chips: ChipArray

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips."""
        return self.chips[row : row + count]


def main() -> None:
    """Make the data, measure, print the tables, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    world = make_world(np.random.default_rng(2), size_m=1_200.0)
    outcomes = [
        outcome
        for case, pairs in cases(world, arguments.pairs).items()
        for outcome in measure(case, pairs, arguments.repeats)
    ]
    show(outcomes)
    points = measure_points(world, arguments.repeats)
    show_points(points)
    keep(
        "correlation",
        {"chips": [asdict(o) for o in outcomes], "points": [asdict(o) for o in points]},
    )


def view(
    world: World,
    seed: int,
    acquired_at: datetime,
    incidence_deg: float = 8.0,
    azimuth_deg: float = 100.0,
) -> SimulatedView:
    """An image of the middle of the world."""
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan(
        f"view_{seed}",
        (lon, lat),
        (SIDE_PX, SIDE_PX),
        IMAGE_GSD_M,
        incidence_deg,
        azimuth_deg,
        acquired_at,
    )
    return simulate_view(world, plan, np.random.default_rng(seed))


def cases(world: World, count: int) -> dict[str, list[Pair]]:
    """Pairs with known displacements, by case."""
    first = view(world, 1, JUNE)
    noise, day = view(world, 2, JUNE), view(world, 3, JULY)
    rng = np.random.default_rng(5)
    # Windows are north-up, images are not: the corners of a window reach further.
    margin_px = np.sqrt(2.0) * (CHIP_SIZE // 2 + RADIUS_PX + FARTHEST_PX + 5.0) * GSD_M / IMAGE_GSD_M
    line_sample = rng.uniform(margin_px, SIDE_PX - margin_px, (count, 2))
    ground = true_ground(first, world, line_sample)
    offset_px = rng.uniform(-FARTHEST_PX, FARTHEST_PX, (count, 2))
    east_north_up = np.column_stack([offset_px[:, 1], -offset_px[:, 0], np.zeros(count)]) * GSD_M
    centre = move_metres(ground, east_north_up)
    chips = [rendered(first, point, CHIP_SIZE) for point in ground]

    def pairs(other: SimulatedView) -> list[Pair]:
        return [
            Pair(chip, rendered(other, place, CHIP_SIZE + 2 * RADIUS_PX), -offset)
            for chip, place, offset in zip(chips, centre, offset_px, strict=True)
        ]

    there = pairs(noise)
    elsewhere = [
        Pair(pair.chip, far.patch, np.full(2, np.nan))
        for pair, far in zip(there, farthest(there, ground), strict=True)
    ]
    return {"other noise": there, "another day": pairs(day), "not there": elsewhere}


def farthest(pairs: list[Pair], ground: Array) -> list[Pair]:
    """For each pair the pair that lies farthest from it."""
    distance = np.linalg.norm(ground[:, None, :2] - ground[None, :, :2], axis=2)
    return [pairs[k] for k in distance.argmax(axis=1)]


def rendered(image: SimulatedView, point: Array, size: int) -> FloatImage:
    """The pixels of an image around a point, on a north-up grid."""
    return render_chip(image.image, image.geometry.rpc, point, GSD_M, size)


def plain(patch: FloatImage, chip: FloatImage) -> Array:
    """The place of the largest correlation."""
    scores = cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return np.array([row - RADIUS_PX, col - RADIUS_PX], dtype=np.float64)


def with_parabola(patch: FloatImage, chip: FloatImage) -> Array:
    """The top of a parabola along each axis, where the largest correlation is not on the border."""
    scores = cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(int(np.argmax(scores)), scores.shape)
    place = np.array([row - RADIUS_PX, col - RADIUS_PX], dtype=np.float64)
    if 0 < row < scores.shape[0] - 1 and 0 < col < scores.shape[1] - 1:
        place[0] += top(*scores[row - 1 : row + 2, col].tolist())
        place[1] += top(*scores[row, col - 1 : col + 2].tolist())
    return place


def top(before: float, at: float, after: float) -> float:
    """Position of the maximum of a parabola through three values, relative to the middle one."""
    return (before - after) / (2.0 * (before - 2.0 * at + after))


def measure(case: str, pairs: list[Pair], repeats: int) -> list[Outcome]:
    """Times and errors of the three algorithms on the same pairs."""
    ways: dict[str, Callable[[FloatImage, FloatImage], object]] = {
        "matchTemplate": plain,
        "with parabola": with_parabola,
        "find_chip": lambda patch, chip: find_chip(patch, chip, OPTIONS),
    }
    taken_s = cpu_medians_s({name: partial(run, way, pairs) for name, way in ways.items()}, repeats)
    places = {
        "matchTemplate": np.array([plain(pair.patch, pair.chip) for pair in pairs]),
        "with parabola": np.array([with_parabola(pair.patch, pair.chip) for pair in pairs]),
    }
    peaks = [find_chip(pair.patch, pair.chip, OPTIONS) for pair in pairs]
    places["find_chip"] = np.array([peak.row_col for peak in peaks])
    true = np.array([pair.row_col for pair in pairs])
    reasons = Counter(peak.reason for peak in peaks if peak.reason != FOUND)
    rejected = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    outcomes = []
    for name, place in places.items():
        error = place - true
        size = np.hypot(*error.T)
        size = size[np.isfinite(size)]
        outcomes.append(
            Outcome(
                case,
                name,
                len(pairs),
                int(np.isfinite(place[:, 0]).sum()),
                1e3 * taken_s[name] / len(pairs),
                float(np.median(size)) if len(size) else None,
                float(size.max()) if len(size) else None,
                error_over_sigma(error, peaks) if name == "find_chip" and len(size) else None,
                rejected if name == "find_chip" else "",
            )
        )
    return outcomes


def run(way: Callable[[FloatImage, FloatImage], object], pairs: list[Pair]) -> None:
    """Run one algorithm on all pairs."""
    for pair in pairs:
        way(pair.patch, pair.chip)


def error_over_sigma(error: Array, peaks: Sequence[Peak]) -> float:
    """Root mean square of errors over their sigmas; 1 for honest sigmas."""
    accepted = np.array([peak.reason == FOUND for peak in peaks])
    sigma = np.array([peak.sigma_px for peak in peaks])[accepted, None]
    return float(np.sqrt(np.mean((error[accepted] / sigma) ** 2)))


def measure_points(world: World, repeats: int) -> list[PointOutcome]:
    """Times of `match_points` and its parts on points with two chips each."""
    references = [view(world, 11, JUNE, 10.0, 100.0), view(world, 12, JULY, 10.0, 290.0)]
    scene = view(world, 13, datetime(2024, 6, 30, 10, 25, tzinfo=UTC), 14.0, 200.0)
    rng = np.random.default_rng(6)
    corners = true_ground(scene, world, np.array([[350.0, 350.0], [SIDE_PX - 350.0, SIDE_PX - 350.0]]))
    lon_lat = rng.uniform(corners[:, :2].min(axis=0), corners[:, :2].max(axis=0), (400, 2))
    true = [Scene(one.image, one.geometry.rpc, one.geometry.acquisition, 0.0) for one in references]
    points, cut = lay_points(world, true, lon_lat, (GSD_M,))
    chips = MemoryChips(np.concatenate([cut(row) for row in range(len(points))]))
    model, size = scene.geometry.rpc, CHIP_SIZE + 2 * RADIUS_PX
    patches = [render_chip(scene.image, model, point, GSD_M, size) for point in points.lon_lat_h]
    seen = [chip_pixels(chip) for chip in chips.chips]
    both = [(patches[row // 2], chip) for row, chip in enumerate(seen)]
    memory = scene.image
    with tempfile.TemporaryDirectory(prefix="amers-bench-") as name:
        path = Path(name) / "scene.tif"
        write_raster(path, scene.pixels)
        file = open_raster(path)
        taken_s = cpu_medians_s(
            {
                "rendering of a window of 181 px": lambda: [
                    render_chip(memory, model, point, GSD_M, size) for point in points.lon_lat_h
                ],
                "two times matchTemplate": lambda: [
                    cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED) for patch, chip in both
                ],
                "two times find_chip": lambda: [find_chip(patch, chip, OPTIONS) for patch, chip in both],
                "match_points, scene in memory": lambda: matched(memory, scene, points, chips),
                "match_points, scene in a compressed file": lambda: matched(file, scene, points, chips),
            },
            repeats,
        )
        file.close()
    return [PointOutcome(what, 1e3 * taken / len(points)) for what, taken in taken_s.items()]


def matched(image: ImageSource, scene: SimulatedView, points: ControlPoints, chips: MemoryChips) -> None:
    """Search all points in an image; most must be found."""
    options = MatchingOptions()
    search = ChipSearch(image, scene.geometry.rpc, scene.geometry.acquisition, GSD_M, RADIUS_PX)
    matches = match_points(search, points, chips, options)
    assert (matches.reason == "").sum() > len(points) / 2


def show(outcomes: list[Outcome]) -> None:
    """Print the table of the chips."""
    table = Table(
        "case",
        "way",
        "CPU",
        "accepted",
        "median error",
        "largest",
        "error / sigma",
        "rejected",
        title=f"a chip of 101 px in a window of 181 px, {outcomes[0].pairs} pairs",
    )
    for o in outcomes:
        table.add_row(
            o.case,
            o.way,
            f"{o.cpu_ms:.3f} ms",
            str(o.accepted),
            "" if o.median_error_px is None else f"{o.median_error_px:.3f} px",
            "" if o.largest_error_px is None else f"{o.largest_error_px:.3f} px",
            "" if o.error_over_sigma is None else f"{o.error_over_sigma:.2f}",
            o.rejected,
        )
    Console(width=140).print(table)


def show_points(outcomes: list[PointOutcome]) -> None:
    """Print the table of the points."""
    table = Table("a point with two chips", "CPU")
    for o in outcomes:
        table.add_row(o.what, f"{o.cpu_ms:.2f} ms")
    Console(width=105).print(table)


if __name__ == "__main__":
    main()
