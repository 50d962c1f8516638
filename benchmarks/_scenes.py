"""The scene of a trial: what a registration gets, and the truth about it."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np

from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource
from amers.services.matching.predict import in_image
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.conditions import Conditions
from amers.services.simulation.defects import Damage, DamagedImage
from amers.services.simulation.detectors import Detectors
from amers.services.simulation.distortion import Distortion
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TILE_PX, TiledView, Tiles
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World, with_smoother_terrain
from amers.services.types import Array, ControlPoints, IntArray
from benchmarks._campaign import fingerprint
from benchmarks._distortions import distortion_of
from benchmarks._point_errors import BlockErrors, spoil
from benchmarks._trials import Trial
from benchmarks._worlds import Block, Place, world_of


@dataclass(frozen=True)
class Truth:
    """What the pixels of a scene show, and how well points can tell.

    Attributes:
        line_sample: (n, 2) pixels all over the image that show what belongs there.
        on_earth: (n, 3) their ground.
        in_frame: the same (n, 3), as points say that are used, by their blocks (k,).
        judged_share: of the image that such pixels stand for.
        shown_points: number of points that the image shows.
        shortest_px: period that points must resolve to follow the distortion, see `Drawn`.
    """

    line_sample: Array
    on_earth: Array
    in_frame: Callable[[IntArray], Array]
    judged_share: float
    shown_points: int
    shortest_px: float = 0.0


@dataclass(frozen=True)
class Prepared:
    """A scene and points with errors, and the truth.

    Attributes:
        scene, points: what a registration gets.
        world: what the scene shows.
        geometry, detectors, distortion: the truth about its image.
        errors: of the blocks of the points.
        shortest_px: period that points must resolve to follow the distortion, see `Drawn`.
    """

    scene: Scene
    points: ControlPoints
    world: World
    geometry: ViewGeometry
    detectors: Detectors
    errors: BlockErrors
    distortion: Distortion
    shortest_px: float = 0.0

    def shown(self, line_sample: Array) -> Array:
        """The ground (n, 3) that pixels (n, 2) show."""
        seen = self.detectors.seen(line_sample, self.scene.image.shape[1])
        return surface_seen(self.world, self.geometry.true_model, self.distortion.undistorted(seen))

    def truth(self) -> Truth:
        """The truth at pixels all over the image."""
        shape = self.scene.image.shape
        axes = [np.linspace(0.0, size - 1.0, n) for size, n in zip(shape, self._judged, strict=True)]
        pixels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        unique = self.distortion.is_unique(pixels)
        pixels = pixels[unique]
        on_earth = self.shown(pixels)
        place = self.geometry.true_model.project(self.points.lon_lat_h)
        return Truth(
            line_sample=pixels,
            on_earth=on_earth,
            in_frame=partial(self.errors.in_frame, on_earth),
            judged_share=float(unique.mean()),
            shown_points=int(in_image(place, shape, 0.0).sum()),
            shortest_px=self.shortest_px,
        )

    @property
    def _judged(self) -> tuple[int, int]:
        """Numbers of pixels along lines and samples that are judged: jitter needs many lines."""
        return (12, 12) if self.distortion.is_none else (48, 12)


def prepare(place: Place, trial: Trial, block: Block, seed: int, tiles: Tiles | None = None) -> Prepared:
    """The scene of a trial, with errors in its model, in its pixels and in the points.

    Args:
        place: its world.
        trial: what is drawn.
        block: the points without errors.
        seed: of the campaign.
        tiles: of the scene, rendered before; those that are rendered are added.
    """
    world = world_of(place)
    if trial.terrain_m > 0.0:
        world = with_smoother_terrain(world, trial.terrain_m)
    rng = np.random.default_rng([seed, trial.number, 1])
    more = np.random.default_rng([seed, trial.number, 2])
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
    steps = more.uniform(-1.0, 1.0, (trial.parts, 2)) * trial.seam_px
    detectors = Detectors(steps - steps.mean(axis=0), (trial.smear_px, trial.blur_px))
    shape = place.lines, place.lines
    distorting = np.random.default_rng([seed, trial.number, 6])
    distortion = distortion_of(trial.distortion, shape, trial.gsd_m, distorting)
    image: ImageSource = TiledView(
        world,
        geometry,
        int(rng.integers(2**31)),
        conditions,
        detectors,
        distortion=distortion,
        tiles=tiles,
    )
    if trial.bits != 12 or trial.damaged > 0.0:
        damage = Damage(trial.bits, trial.damaged, trial.missing, trial.patch_px, trial.brightest)
        image = DamagedImage(image, damage, trial.number)
    delivered = geometry.delivered
    if trial.distortion.tilt_deg > 0.0:
        delivered = _of_another_view(world, plan, trial, error_m, distorting)
    scene = Scene(image, delivered, geometry.acquisition, trial.sigma_m)
    side_m = trial.gsd_m * place.lines
    points, errors = spoil(block.points, trial, world.centre_lon_lat, side_m, rng=rng, more=more)
    shortest_px = trial.distortion.shortest_px
    return Prepared(scene, points, world, geometry, detectors, errors, distortion, shortest_px)


def _of_another_view(
    world: World, plan: ViewPlan, trial: Trial, error_m: tuple[float, float], rng: np.random.Generator
) -> RpcModel:
    """The model of a view from another direction, of the same place or of one beside it."""
    incidence, azimuth = np.radians([trial.incidence_deg, trial.azimuth_deg])
    towards = rng.uniform(0.0, 2.0 * np.pi, 2)
    direction = np.tan(incidence) * np.array([np.sin(azimuth), np.cos(azimuth)])
    tilt = np.tan(np.radians(trial.distortion.tilt_deg))
    direction += tilt * np.array([np.sin(towards[0]), np.cos(towards[0])])
    away_m = trial.distortion.away * plan.gsd_m * plan.shape[0]
    per_degree = metres_per_degree(plan.lon_lat[1], 0.0)
    east, north = away_m * np.sin(towards[1]), away_m * np.cos(towards[1])
    other = replace(
        plan,
        lon_lat=(plan.lon_lat[0] + east / per_degree[0], plan.lon_lat[1] + north / per_degree[1]),
        incidence_deg=float(np.degrees(np.arctan(np.hypot(*direction)))),
        azimuth_deg=float(np.degrees(np.arctan2(*direction)) % 360.0),
    )
    return plan_geometry(world, other, rng, error_m).delivered


def pixels_file(folder: Path, name: str) -> Path:
    """The file of the pixels of a scene, as the sources draw it."""
    drawing = fingerprint("services/simulation", "scenes", "distortions", "trials", "worlds")
    return folder / f"pixels_{name}_{drawing}.npz"


def read_tiles(file: Path) -> Tiles:
    """The tiles of a scene that an earlier run rendered; none where there is no file."""
    tiles: Tiles = OrderedDict()
    if not file.exists():
        return tiles
    with np.load(file) as kept:
        pixels, known = kept["pixels"], kept["known"]
    for row, column in np.argwhere(known).tolist():
        tiles[row, column] = pixels[_of_tile(row, column)].copy()
    return tiles


def keep_tiles(tiles: Tiles, shape: tuple[int, int], file: Path) -> None:
    """Keep the tiles of a scene of lines and samples in a file."""
    pixels = np.zeros(shape, dtype=np.uint16)
    known = np.zeros([-(-size // TILE_PX) for size in shape], dtype=bool)
    for (row, column), tile in tiles.items():
        pixels[_of_tile(row, column)] = tile
        known[row, column] = True
    part = file.with_suffix(".part.npz")
    np.savez(part, pixels=pixels, known=known)
    part.replace(file)


def _of_tile(row: int, column: int) -> tuple[slice, slice]:
    starts = row * TILE_PX, column * TILE_PX
    return slice(starts[0], starts[0] + TILE_PX), slice(starts[1], starts[1] + TILE_PX)
