"""Changes on the ground over the years: new buildings, and objects that appear and disappear."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta

import numpy as np

from amers.services.simulation.land import NO_ROOF, WATER
from amers.services.simulation.world import World
from amers.services.types import Array, IntArray

_SIDE_M = (20.0, 140.0)
"""Shortest and longest side of a changed rectangle."""
_LEAST_ROOF_M = 3.0
_THING_M = (3.0, 12.0)
_THING_ALBEDO = ((0.03, 0.08), (0.55, 1.0))
"""Ranges of the albedo of dark and of bright things: vehicles, boats, containers, stacks."""
_CLEARED_ALBEDO = 0.28


@dataclass(frozen=True)
class Change:
    """A rectangle whose cover becomes another on a day.

    Attributes:
        day: from this day on.
        corner: row and column of its first cell.
        shape: rows and columns.
        source: first cell of the rectangle whose cover it takes; None when it is cleared.
    """

    day: date
    corner: tuple[int, int]
    shape: tuple[int, int]
    source: tuple[int, int] | None


def draw_changes(
    world: World, rng: np.random.Generator, first: date, last: date, share_a_year: float
) -> tuple[Change, ...]:
    """Random changes of a world between two days, by day.

    Args:
        world: the ground before.
        rng: source of randomness.
        first, last: days.
        share_a_year: of the ground that changes in a year; water never does.
    """
    days = (last - first).days
    rows, columns = world.terrain_m.shape
    left = share_a_year * days / 365.25 * rows * columns
    changes = []
    while left > 0.0:
        height, width = (rng.uniform(*_SIDE_M, 2) / world.posting_m).astype(int).tolist()
        left -= height * width
        top = int(rng.integers(0, max(1, rows - height)))
        start = int(rng.integers(0, max(1, columns - width)))
        source = int(rng.integers(0, rows - height)), int(rng.integers(0, columns - width))
        day = first + timedelta(days=int(rng.integers(0, days + 1)))
        cleared = rng.uniform() < 0.3
        changes.append(Change(day, (top, start), (height, width), None if cleared else source))
    return tuple(sorted(changes, key=lambda change: change.day))


def apply_changes(world: World, changes: Sequence[Change], day: date) -> World:
    """The world on a day; its arrays change in place, and the world given is of no more use.

    A rectangle that takes the cover of another gets its roofs at the same heights above the ground.
    Water neither changes nor is copied.
    """
    for change in changes:
        if change.day <= day:
            _apply(world, change)
    return World(
        world.seed,
        world.origin_lon_lat,
        world.step_deg,
        world.posting_m,
        world.terrain_m,
        world.roof_m,
        world.albedo,
        world.parcel,
    )


def _apply(world: World, change: Change) -> None:
    place = _rectangle(change.corner, change.shape)
    ground = world.terrain_m[place]
    changed = world.parcel[place] != WATER
    if change.source is None:
        world.roof_m[place][changed] = NO_ROOF
        world.albedo[place][changed] *= np.float32(0.2)
        world.albedo[place][changed] += np.float32(_CLEARED_ALBEDO)
        world.parcel[place][changed] = 0
        return
    source = _rectangle(change.source, change.shape)
    changed &= world.parcel[source] != WATER
    rise = ground[0, 0] - world.terrain_m[source][0, 0]
    roof = world.roof_m[source] + rise
    roof[roof < ground + np.float32(_LEAST_ROOF_M)] = NO_ROOF
    albedo, parcel = world.albedo[source].copy(), world.parcel[source].copy()
    world.roof_m[place][changed] = roof[changed]
    world.albedo[place][changed] = albedo[changed]
    world.parcel[place][changed] = parcel[changed]


def _rectangle(corner: tuple[int, int], shape: tuple[int, int]) -> tuple[slice, slice]:
    return slice(corner[0], corner[0] + shape[0]), slice(corner[1], corner[1] + shape[1])


def scatter_things(world: World, rng: np.random.Generator, per_km2: float) -> IntArray:
    """Put things of a few metres on open ground and water, bright or dark, in place.

    Returns:
        (n, 2) row and column of the things.
    """
    rows, columns = world.terrain_m.shape
    count = rng.poisson(per_km2 * rows * columns * world.posting_m**2 * 1e-6)
    corner = np.column_stack([rng.integers(0, rows, count), rng.integers(0, columns, count)])
    size = np.maximum(np.rint(rng.uniform(*_THING_M, (count, 2)) / world.posting_m).astype(int), 1)
    albedo = _albedo_of_things(rng, count)
    for (row, column), (height, width), value in zip(corner, size, albedo, strict=True):
        place = world.albedo[row : row + height, column : column + width]
        roofs = world.roof_m[row : row + height, column : column + width]
        place[roofs == NO_ROOF] = value
    return corner.astype(np.int64)


def _albedo_of_things(rng: np.random.Generator, count: int) -> Array:
    dark, bright = (rng.uniform(*limits, count) for limits in _THING_ALBEDO)
    return np.where(rng.uniform(size=count) < 0.3, dark, bright)
