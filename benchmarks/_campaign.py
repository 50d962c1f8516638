"""Scenes of simulated worlds under all that makes registration hard, and what became of them.

A world and its block of points are made once and serve many scenes. A scene is rendered only where it is
looked at. Everything follows from the number of the scene and the seed of the campaign.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from math import atan, degrees
from pathlib import Path

import numpy as np

from benchmarks._simulated import lay_points
from services.errors import AmersError
from services.imagery import render_chip
from services.intersection import move_metres
from services.production import stored_chip
from services.quality.accuracy import CIRCULAR_CE90, accuracy, normalised_error
from services.registration import Registration, RegistrationOptions, register_scene
from services.scene import Scene
from services.simulation.conditions import Conditions
from services.simulation.render import STEEPEST, surface_seen
from services.simulation.tiles import TiledView
from services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from services.simulation.world import World, make_world
from services.types import Acquisition, Array, ChipArray, ControlPoints, Views

FINE_GSD_M, COARSE_GSD_M = 2.0, 20.0
COARSE_REFERENCE_GSD_M = 8.0
FRAME_SIGMA_M = 0.5
LE90_OF_CE90 = 5.0 / 3.0
"""Of the points: SRP's 5 m to 3 m."""
WRONG = 3.0
"""A result is wrong when its CE90 is more than so many times the predicted one."""
REFERENCES = (
    (12.0, 100.0, datetime(2024, 5, 28, 10, 25, tzinfo=UTC)),
    (10.0, 290.0, datetime(2024, 7, 14, 10, 50, tzinfo=UTC)),
    (20.0, 200.0, datetime(2024, 8, 20, 10, 40, tzinfo=UTC)),
)
"""Incidence, azimuth and time of the views a block is made from."""


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
    """

    name: str
    seed: int
    size_m: float
    posting_m: float
    relief_m: float
    patterned_share: float
    gsd_m: tuple[float, float]
    lines: int
    points: int = 22


PLACES = tuple(
    Place(f"{kind}_{k}", 2 * k + (kind == "hills"), size_m, posting_m, relief_m, share, gsds_m, lines)
    for k, (size_m, posting_m, gsds_m, lines, low_m, high_m) in enumerate(
        (
            (2_700.0, 0.5, (0.2, 0.45), 5000, 20.0, 120.0),
            (4_000.0, 0.7, (0.45, 0.95), 3600, 60.0, 250.0),
            (5_000.0, 1.0, (0.95, 2.1), 2000, 100.0, 350.0),
            (9_500.0, 2.0, (2.1, 4.5), 1800, 200.0, 900.0),
            (17_500.0, 4.0, (4.5, 9.5), 1600, 300.0, 1_800.0),
            (32_000.0, 8.0, (9.5, 20.0), 1400, 100.0, 2_000.0),
        )
    )
    for kind, relief_m, share in (
        ("plain", low_m, 0.6 * (k % 2)),
        ("hills", high_m, 0.6 * (1 - k % 2)),
    )
)
NOMINAL = Place("nominal", 77, 1_700.0, 0.5, 60.0, 0.0, (0.5, 0.5), 2900)
"""SRP's conditions: some 200 points of 3 m CE90 with chips of 2 m, in a scene of 0.5 m."""


@dataclass(frozen=True)
class Trial:
    """What is done to one scene.

    Attributes:
        number: of the scene.
        place: its world.
        gsd_m: of the scene.
        incidence_deg, azimuth_deg: of the scene.
        day: of the year 2024.
        location_error_m, sigma_m: how far off the model is, and how far it is said to be at one sigma.
        drift_px: largest drift and skew at the edges of the image.
        conditions: haze, clouds, inversion, season, noise.
        vanished, moved: shares of the points.
        point_ce90_m: as declared.
        understated: how many times larger the errors of the points are.
        relief_m, patterned_share: of the world, for the tables.
        chip_ratio: ground sampling of the scene over that of the finest chips.
    """

    number: int
    place: str
    gsd_m: float
    incidence_deg: float
    azimuth_deg: float
    day: int
    location_error_m: float
    sigma_m: float
    drift_px: float
    haze: float
    cloud_cover: float
    inverted: bool
    season: float
    noise: float
    vanished: float
    moved: float
    point_ce90_m: float
    understated: float
    relief_m: float
    patterned_share: float
    chip_ratio: float


@dataclass(frozen=True)
class Outcome:
    """What became of one scene.

    Attributes:
        verdict: "good", "usable" or "failed"; "refused" when there is no result.
        reason: why there is none.
        visible, matched, active: points.
        ce90_before_m, ce90_m: against the truth in the frame of the block, over the whole image.
        ground_ce90_m: against the truth on the Earth.
        predicted_m, predicted_worst_m: CE90 as stated, median and worst over the image.
        normalised: mean square of true errors over stated deviations, over the image.
        displacement_m: stability test, largest of the corners' medians.
        cpu_s: of the registration with what it renders.
    """

    verdict: str
    reason: str
    visible: int
    matched: int
    active: int
    order: str
    ce90_before_m: float
    ce90_m: float
    ground_ce90_m: float
    predicted_m: float
    predicted_worst_m: float
    normalised: float
    displacement_m: float
    cpu_s: float

    @property
    def delivered(self) -> bool:
        """Whether the registration says that its model may be used."""
        return self.verdict in ("good", "usable")

    @property
    def wrong(self) -> bool:
        """Whether the true error is more than `WRONG` times the predicted one."""
        return not self.ce90_m <= WRONG * self.predicted_m


def draw_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number: a few factors over their whole range, the others mild."""
    rng = np.random.default_rng([seed, number])
    place = places[number % len(places)]

    def either(mild: tuple[float, float], hard: tuple[float, float]) -> float:
        return float(rng.uniform(*(hard if rng.uniform() < 0.2 else mild)))

    gsd_m = float(np.exp(rng.uniform(*np.log(place.gsd_m))))
    largest_m = min(2_000.0, 0.15 * gsd_m * place.lines)
    error_m = float(np.exp(rng.uniform(0.0, np.log(largest_m))))
    vanished = either((0.0, 0.1), (0.1, 0.5))
    return Trial(
        number=number,
        place=place.name,
        gsd_m=gsd_m,
        incidence_deg=float(rng.uniform(0.0, min(35.0, _largest_incidence_deg(place)))),
        azimuth_deg=float(rng.uniform(0.0, 360.0)),
        day=int(rng.integers(60, 300)),
        location_error_m=error_m,
        sigma_m=error_m / float(rng.uniform(1.2, 2.6)),
        drift_px=either((0.0, 1.0), (1.0, 6.0)),
        haze=either((0.0, 0.2), (0.2, 0.85)),
        cloud_cover=either((0.0, 0.1), (0.1, 0.7)),
        inverted=bool(rng.uniform() < 0.1),
        season=either((0.0, 0.1), (0.1, 1.0)),
        noise=either((4.0, 15.0), (15.0, 120.0)),
        vanished=vanished,
        moved=either((0.0, 0.1), (0.0, 0.5 - vanished)),
        point_ce90_m=float(np.exp(rng.uniform(*np.log((0.5, 5.0))))),
        understated=either((1.0, 1.0), (1.0, 3.0)),
        relief_m=place.relief_m,
        patterned_share=place.patterned_share,
        chip_ratio=gsd_m / FINE_GSD_M,
    )


def nominal_trial(seed: int, number: int, place: Place = NOMINAL) -> Trial:
    """SRP's conditions: nothing is wrong but the location of the scene and what is declared."""
    mild = draw_trial(seed, number, (place,))
    return replace(
        mild,
        gsd_m=place.gsd_m[0],
        incidence_deg=min(mild.incidence_deg, 20.0),
        location_error_m=10.0,
        sigma_m=5.0,
        drift_px=1.0,
        haze=0.0,
        cloud_cover=0.0,
        inverted=False,
        season=0.0,
        noise=0.0,
        vanished=0.0,
        moved=0.0,
        point_ce90_m=3.0,
        understated=1.0,
        chip_ratio=place.gsd_m[0] / FINE_GSD_M,
    )


@lru_cache(maxsize=1)
def world_of(place: Place) -> World:
    """The world of a place; one is kept at a time."""
    rng = np.random.default_rng([place.seed, 1])
    return make_world(
        rng,
        place.size_m,
        place.posting_m,
        place.relief_m,
        lowest_m=150.0,
        smallest_hill_m=_hill_m(place),
        patterned_share=place.patterned_share,
    )


def _hill_m(place: Place) -> float:
    return max(350.0, 0.03 * place.size_m, 0.5 * place.relief_m)


def _largest_incidence_deg(place: Place) -> float:
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
    file = folder / f"block_{place.name}_{place.seed}.npz" if folder else None
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
        min(incidence_deg, _largest_incidence_deg(place)),
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
        kept["saliency"],
        np.ones(n),
        views,
        np.zeros(n, dtype=np.int64),
        start[:-1].copy(),
        ("chips",),
    )
    return Block(points, kept["chips"])


@dataclass(frozen=True)
class Prepared:
    """A scene as it is handed over, and its truth."""

    scene: Scene
    points: ControlPoints
    geometry: ViewGeometry
    frame_shift_m: Array


def prepare(place: Place, trial: Trial, block: Block, seed: int) -> Prepared:
    """Take the scene of a trial and spoil its model and its points."""
    world = world_of(place)
    rng = np.random.default_rng([seed, trial.number, 1])
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan(
        f"scene_{trial.number}",
        (lon, lat),
        (place.lines, place.lines),
        trial.gsd_m,
        trial.incidence_deg,
        trial.azimuth_deg,
        datetime(2024, 1, 1, 10, 40, tzinfo=UTC) + timedelta(days=trial.day),
    )
    towards = rng.uniform(0.0, 2.0 * np.pi)
    error_m = trial.location_error_m * np.sin(towards), trial.location_error_m * np.cos(towards)
    error_px = np.zeros((2, 3))
    error_px[:, 1:] = trial.drift_px * rng.uniform(-1.0, 1.0, (2, 2))
    geometry = plan_geometry(world, plan, rng, error_m, error_px)
    conditions = Conditions(trial.haze, trial.cloud_cover, trial.inverted, trial.season, trial.noise)
    image = TiledView(world, geometry, int(rng.integers(2**31)), conditions)
    scene = Scene(image, geometry.delivered, geometry.acquisition, trial.sigma_m)
    shift_m = np.append(rng.normal(0.0, FRAME_SIGMA_M, 2), 0.0)
    return Prepared(scene, _spoiled(block.points, trial, shift_m, rng), geometry, shift_m)


def _spoiled(
    points: ControlPoints, trial: Trial, shift_m: Array, rng: np.random.Generator
) -> ControlPoints:
    """Points with the errors of a trial: all shifted, each displaced, some moved, some vanished."""
    n = len(points)
    sigma_m = trial.point_ce90_m * np.array(
        [1.0 / CIRCULAR_CE90, 1.0 / CIRCULAR_CE90, LE90_OF_CE90 / 1.6449]
    )
    offset_m = shift_m + trial.understated * sigma_m * rng.standard_normal((n, 3))
    order = rng.permutation(n)
    moved, vanished = np.split(order, [round(trial.moved * n)])
    vanished = vanished[: round(trial.vanished * n)]
    far_m = rng.uniform(2.0, 20.0, len(moved)) * max(FINE_GSD_M, trial.gsd_m)
    towards = rng.uniform(0.0, 2.0 * np.pi, len(moved))
    offset_m[moved, :2] += far_m[:, None] * np.column_stack([np.sin(towards), np.cos(towards)])
    chip_row = points.chip_row.copy()
    chip_row[vanished] = np.roll(chip_row[vanished], 1)
    return replace(
        points,
        lon_lat_h=move_metres(points.lon_lat_h, offset_m),
        covariance_m2=points.covariance_m2 + np.diag(sigma_m**2),
        chip_row=chip_row,
    )


def attempt(
    place: Place, trial: Trial, block: Block, seed: int, options: RegistrationOptions
) -> Outcome:
    """Register the scene of a trial and hold the result against the truth."""
    prepared = prepare(place, trial, block, seed)
    world = world_of(place)
    start_s = time.process_time()
    try:
        registration = register_scene(
            prepared.scene,
            prepared.points,
            replace(block, points=prepared.points),
            options,
            frame_sigma_m=FRAME_SIGMA_M,
        )
    except AmersError as error:
        nan = float("nan")
        cpu_s = time.process_time() - start_s
        return Outcome("refused", str(error), 0, 0, 0, "", nan, nan, nan, nan, nan, nan, nan, cpu_s)
    return _judged(world, prepared, registration, time.process_time() - start_s)


def _judged(world: World, prepared: Prepared, registration: Registration, cpu_s: float) -> Outcome:
    """Figures of a registration against the true sensor, on a grid over the whole image."""
    shape = prepared.scene.image.shape
    axes = [np.linspace(0.0, size - 1.0, 12) for size in shape]
    line_sample = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    shown = surface_seen(world, prepared.geometry.true_model, line_sample)
    in_frame = move_metres(shown, np.broadcast_to(prepared.frame_shift_m, shown.shape))

    def error_px(ground: Array) -> Array:
        return np.asarray(registration.model.project(ground) - line_sample)

    inverse = np.linalg.inv(registration.model.project_derivative(shown)[:, :, :2])

    def ce90_m(error: Array) -> float:
        return accuracy((inverse @ error[:, :, None])[:, :, 0]).ce90_m.value

    error = error_px(in_frame)
    before = prepared.scene.model.project(shown) - line_sample
    quality = registration.qualification
    honest = normalised_error(error, registration.adjustment.covariance_at(line_sample))
    moved_m = [place.median_m for place in quality.stability.displacements]
    return Outcome(
        verdict=quality.verdict,
        reason="; ".join(c.name for c in quality.criteria if not c.passed),
        visible=quality.equipment.visible,
        matched=quality.equipment.matched,
        active=quality.equipment.active,
        order=registration.adjustment.order,
        ce90_before_m=ce90_m(before),
        ce90_m=ce90_m(error),
        ground_ce90_m=ce90_m(error_px(shown)),
        predicted_m=quality.predicted.median_m,
        predicted_worst_m=quality.predicted.worst_m,
        normalised=honest.mean_square,
        displacement_m=max(moved_m, default=float("nan")),
        cpu_s=cpu_s,
    )


def record(trial: Trial, outcome: Outcome) -> dict[str, dict[str, object]]:
    """A line of the file a campaign is kept in."""
    return {"trial": asdict(trial), "outcome": asdict(outcome)}


def in_order_of_places(numbers: Iterator[int] | range, places: tuple[Place, ...]) -> list[int]:
    """Numbers of trials so that a world is made once."""
    return sorted(numbers, key=lambda number: (number % len(places), number))
