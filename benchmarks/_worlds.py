"""Simulated worlds that scenes are taken of, and their blocks of control points.

A world and its block are made once and serve many scenes.
"""

import zlib
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from math import atan, degrees
from pathlib import Path

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.multi_image import stored_chip
from amers.services.simulation.render import STEEPEST
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import UNKNOWN_FRAME, Acquisition, Array, ChipArray, ControlPoints, Views
from benchmarks._simulated import lay_points

FINE_GSD_M, COARSE_GSD_M = 2.0, 20.0
COARSE_REFERENCE_GSD_M = 8.0
REFERENCES = (
    (12.0, 100.0, datetime(2024, 5, 28, 10, 25, tzinfo=UTC)),
    (10.0, 290.0, datetime(2024, 7, 14, 10, 50, tzinfo=UTC)),
    (20.0, 200.0, datetime(2024, 8, 20, 10, 40, tzinfo=UTC)),
    (15.0, 15.0, datetime(2024, 6, 20, 10, 35, tzinfo=UTC)),
)
"""Incidence, azimuth and time of the views a block is made from: from all sides, on different days."""


@dataclass(frozen=True)
class Place:
    """A world and the scenes that are taken of it.

    Attributes:
        name: of the place.
        seed: of the world.
        size_m, posting_m, relief_m, patterned_share: of the world.
        gsd_m: range of the scenes' ground samplings.
        lines: of a scene, and its samples.
        points: along a side of the world.
        centre_lon_lat: of the world, degrees.
    """

    name: str
    seed: int
    size_m: float
    posting_m: float
    relief_m: float
    patterned_share: float
    gsd_m: tuple[float, float]
    lines: int
    points: int
    centre_lon_lat: tuple[float, float] = (5.4, 43.6)


PLACES = tuple(
    Place(
        f"{kind}_{k}",
        2 * k + (kind == "hills"),
        size_m,
        posting_m,
        relief_m,
        share,
        gsds_m,
        lines,
        points,
    )
    for k, (size_m, posting_m, gsds_m, lines, low_m, high_m, points) in enumerate(
        (
            (1_700.0, 0.5, (0.2, 0.45), 2600, 20.0, 120.0, 36),
            (2_600.0, 0.7, (0.45, 0.95), 2200, 60.0, 250.0, 32),
            (5_000.0, 1.0, (0.95, 2.1), 2000, 100.0, 350.0, 28),
            (9_500.0, 2.0, (2.1, 4.5), 1800, 200.0, 900.0, 28),
            (17_500.0, 4.0, (4.5, 9.5), 1600, 300.0, 1_800.0, 28),
            (32_000.0, 8.0, (9.5, 20.0), 1400, 100.0, 2_000.0, 28),
        )
    )
    for kind, relief_m, share in (
        ("plain", low_m, 0.6 * (k % 2)),
        ("hills", high_m, 0.6 * (1 - k % 2)),
    )
)
NOMINAL = Place("nominal", 77, 1_700.0, 0.5, 60.0, 0.0, (0.5, 0.5), 2900, points=40)
"""SRP's conditions: some 450 points of 3 m CE90 with chips of 2 m, in a scene of 0.5 m."""


@lru_cache(maxsize=1)
def world_of(place: Place) -> World:
    """The world of a place; one is kept at a time."""
    rng = np.random.default_rng([place.seed, 1])
    return make_world(
        rng,
        place.size_m,
        place.posting_m,
        place.relief_m,
        centre_lon_lat=place.centre_lon_lat,
        smallest_hill_m=smallest_hill_m(place),
        patterned_share=place.patterned_share,
    )


def smallest_hill_m(place: Place) -> float:
    """Wavelength of the smallest hills of a place."""
    return max(350.0, 0.03 * place.size_m, 0.5 * place.relief_m)


def largest_incidence_deg(place: Place) -> float:
    """What the slopes of a place can be seen under."""
    return degrees(atan(0.98 * STEEPEST / world_of(place).steepest_slope)) - 2.0


@dataclass(frozen=True)
class Block:
    """Points of a place and their chips, in memory."""

    points: ControlPoints
    chips: ChipArray

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips."""
        return self.chips[row : row + count]


def block_of(place: Place, folder: Path | None = None) -> Block:
    """The block of a place, made once and kept in a folder."""
    made_of = zlib.crc32(repr(place).encode())
    file = folder / f"block_{place.name}_{made_of:08x}.npz" if folder else None
    if file is not None and file.exists():
        with np.load(file, allow_pickle=False) as kept:
            return _unpacked(kept)
    block = _make_block(place)
    if file is not None:
        part = file.with_suffix(".part.npz")
        np.savez(part, **_packed(block))
        part.rename(file)
    return block


def _make_block(place: Place) -> Block:
    """Points measured on chips of views whose models are true; see `lay_points`."""
    world = world_of(place)
    rng = np.random.default_rng([place.seed, 2])
    fine = [_reference(place, world, k, FINE_GSD_M) for k in range(len(REFERENCES))]
    step = (np.arange(place.points) + 0.5) / place.points - 0.5
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    grid += rng.uniform(-0.3, 0.3, grid.shape) / place.points
    side = place.size_m / world.posting_m * world.step_deg
    points, cut = lay_points(world, fine, world.centre_lon_lat + grid * side, (FINE_GSD_M,))
    chips = np.stack([cut(row) for row in range(len(points))])
    if place.size_m > 2.0 * 101 * COARSE_GSD_M:
        coarse = [_reference(place, world, k, COARSE_REFERENCE_GSD_M) for k in range(len(REFERENCES))]
        more = np.stack([_chips_at(coarse, ground) for ground in points.lon_lat_h])
        chips = np.concatenate([chips, more], axis=1)
        points = _with_coarse_views(points)
    return Block(points, chips.reshape(-1, *chips.shape[2:]))


def _reference(place: Place, world: World, number: int, gsd_m: float) -> Scene:
    """A view a block is made from, larger than the world."""
    incidence_deg, azimuth_deg, acquired_at = REFERENCES[number]
    side = round((1.3 * place.size_m + 3_000.0) / gsd_m)
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan(
        f"reference_{number}",
        (lon, lat),
        (side, side),
        gsd_m,
        min(incidence_deg, largest_incidence_deg(place)),
        azimuth_deg,
        acquired_at,
    )
    geometry = plan_geometry(world, plan, np.random.default_rng(number))
    image = TiledView(world, geometry, place.seed + number)
    return Scene(image, geometry.rpc, geometry.acquisition, 0.0)


def _chips_at(scenes: list[Scene], ground: Array) -> ChipArray:
    return np.stack(
        [stored_chip(render_chip(scene.image, scene.model, ground, COARSE_GSD_M)) for scene in scenes]
    )


def _with_coarse_views(points: ControlPoints) -> ControlPoints:
    """Every point has the same views once more, coarse."""
    n, k = len(points), len(points.views.images)
    views = points.views

    def twice(values: Array) -> Array:
        return np.tile(values.reshape(n, k), (1, 2)).ravel()

    gsd_m = np.tile(np.repeat([FINE_GSD_M, COARSE_GSD_M], k), n)
    doubled = Views(
        2 * views.start,
        gsd_m,
        twice(views.image),
        twice(views.incidence_deg),
        twice(views.azimuth_deg),
        np.ones(2 * n * k),
        views.images,
    )
    return replace(points, views=doubled, chip_row=2 * points.chip_row)


def _packed(block: Block) -> dict[str, Array]:
    p, v = block.points, block.points.views
    return {
        "chips": block.chips,
        "lon_lat_h": p.lon_lat_h,
        "covariance_m2": p.covariance_m2,
        "saliency": p.saliency,
        "start": v.start,
        "gsd_m": v.gsd_m,
        "image": v.image,
        "incidence_deg": v.incidence_deg,
        "azimuth_deg": v.azimuth_deg,
        "sun": np.array([(i.sun_elevation_deg, i.sun_azimuth_deg) for i in v.images]),
        "taken": np.array([(i.incidence_deg, i.azimuth_deg) for i in v.images]),
    }


def _unpacked(kept: "np.lib.npyio.NpzFile") -> Block:
    n = len(kept["lon_lat_h"])
    images = tuple(
        Acquisition(f"reference_{k}", "simulated pushbroom", REFERENCES[k][2], *taken, *sun)
        for k, (taken, sun) in enumerate(zip(kept["taken"].tolist(), kept["sun"].tolist(), strict=True))
    )
    start = kept["start"]
    views = Views(
        start,
        kept["gsd_m"],
        kept["image"],
        kept["incidence_deg"],
        kept["azimuth_deg"],
        np.ones(int(start[-1])),
        images,
    )
    points = ControlPoints(
        np.arange(n, dtype=np.int64),
        kept["lon_lat_h"],
        kept["covariance_m2"],
        np.zeros(n, dtype=np.int64),
        (UNKNOWN_FRAME,),
        kept["saliency"],
        np.ones(n),
        views,
        np.zeros(n, dtype=np.int64),
        start[:-1].copy(),
        ("chips",),
    )
    return Block(points, kept["chips"])
