"""An archipelago in simulation: ortho-images, stereo pairs, and known sites on four islands.

The islands are ellipses with the places and sizes of Cape Verde, the sites its four airports. No pixels:
every image sees points with a noise, through a model that is off by a shift, drifts and skews. The
ortho-images were made with a terrain that has errors of each island and of each point, which displace
what they show by the tangent of their incidence angle. The published layout of the images is not stated
beyond their numbers; this one follows the orbits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np

from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.geodesy import lon_lat_h_from_east_north_up, metres_per_degree_at, move_metres
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.quality.site_reach import KnownSite
from amers.services.sensors.base import SensorModel
from amers.services.sensors.ortho import OrthoModel, ReliefDisplacement
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations

SITES = {
    "GVAC": (-22.949, 16.741),
    "GVBA": (-22.889, 16.137),
    "GVNP": (-23.494, 14.925),
    "GVSV": (-25.055, 16.833),
}
"""Longitude and latitude of the airports of Sal, Boa Vista, Praia and São Vicente."""
ISLANDS = (
    (-25.17, 17.06, 20.0, 11.0, 1500.0),
    (-24.97, 16.85, 11.0, 7.0, 500.0),
    (-24.25, 16.61, 19.0, 7.0, 900.0),
    (-22.93, 16.73, 6.0, 14.0, 150.0),
    (-22.81, 16.10, 15.0, 14.0, 250.0),
    (-23.16, 15.22, 8.0, 11.0, 250.0),
    (-23.63, 15.08, 14.0, 23.0, 900.0),
    (-24.38, 14.93, 13.0, 12.0, 2200.0),
    (-24.70, 14.85, 5.0, 5.0, 700.0),
)
"""Longitude and latitude of the middle, half axes east and north in km, height in metres."""

TIES = 450
SITE_POINTS = 8
SITE_OWN_M, SITE_FRAME_M = 0.3, 0.7
"""Of the points of a site: each its own error, and the one that all of them share."""
ISLAND_SIGMA_M, POINT_SIGMA_M = 3.0, 2.0
"""Errors of the terrain: one of every island, one of every point."""
NODE_DEG = 0.01
SEEN = 0.7
BLUNDERS = 0.02
BLUNDER_PX = 20.0


@dataclass(frozen=True)
class Kind:
    """What the images of a sensor have in common.

    Attributes:
        shape: lines and samples.
        shift_m: sigma of the shift of their models, each coordinate.
        slope_m: sigma of drifts and skews, at the edge.
        noise_px: of a measure.
        gsd_m: ground sampling.
    """

    shape: tuple[int, int]
    shift_m: float
    slope_m: float
    noise_px: float
    gsd_m: float


ORTHO = Kind((30_000, 38_000), shift_m=4.5, slope_m=0.5, noise_px=0.2, gsd_m=10.0)
STEREO = Kind((24_000, 24_000), shift_m=15.0, slope_m=2.5, noise_px=0.3, gsd_m=5.0)
FINE = Kind((44_000, 40_000), shift_m=10.0, slope_m=2.0, noise_px=0.3, gsd_m=1.5)
"""Ortho-images of a slanting swath of 290 km, stereo pairs, and images that show the sites."""

_HALF_SWATH_M = 145_000.0
_WEST_M, _MIDDLE_M, _ORBITS_M = 761_000.0, 1_785_000.0, 269_000.0
"""Middle of the western swath on the map, and distance of the orbits."""
_TANGENT = 0.2
"""Of the incidence angle at the edge of an ortho-image."""
_ACROSS = np.array([np.sin(np.radians(106.0)), np.cos(np.radians(106.0))])
"""Direction east, north across the track, to the right edge."""


@dataclass(frozen=True)
class Image:
    """An image with its kind and its model as delivered."""

    name: str
    kind: Kind
    model: SensorModel


@dataclass(frozen=True)
class Draw:
    """One draw of an archipelago.

    Attributes:
        images: as delivered.
        kinds: of the images.
        observations: of the points: ties, then those of the sites.
        truth: (p, 3).
        site: (p,) row of the site of every point; -1 for ties.
        heights: of the terrain, at the ties.
        sites: known ground of every site.
    """

    images: tuple[ImageParameters, ...]
    kinds: tuple[Kind, ...]
    observations: Observations
    truth: Array
    site: IntArray
    heights: ControlGround
    sites: tuple[KnownSite, ...]

    def control(self, active: Sequence[int]) -> ControlGround:
        """The heights, and the given sites."""
        return joined_ground([self.heights, *(self.sites[row].ground for row in active)])

    def without(self, kind: Kind) -> "Draw":
        """The same without the images of a kind."""
        kept = np.array([own != kind for own in self.kinds])
        number = np.cumsum(kept) - 1
        seen = self.observations.take(kept[self.observations.image])
        return replace(
            self,
            images=tuple(image for image, stays in zip(self.images, kept, strict=True) if stays),
            kinds=tuple(own for own in self.kinds if own != kind),
            observations=replace(seen, image=number[seen.image]),
        )


@dataclass(frozen=True)
class Ground:
    """Heights on a grid of nodes, and the island (-1: sea) of every node."""

    grid: MapGrid

    @classmethod
    def around_all(cls) -> "Ground":
        shape = (280, 320)
        origin, step = np.array([-25.7, 17.5]), np.array([[0.0, NODE_DEG], [-NODE_DEG, 0.0]])
        return cls(MapGrid("EPSG:4326", origin, step, shape))

    @cached_property
    def nodes(self) -> Array:
        lines, samples = self.grid.shape
        position = np.stack(np.meshgrid(np.arange(lines), np.arange(samples), indexing="ij"), axis=-1)
        return self.grid.lon_lat(position.reshape(-1, 2).astype(np.float64))

    @cached_property
    def island(self) -> IntArray:
        return np.where(self._place.min(axis=0) < 1.0, self._place.argmin(axis=0), -1)

    @cached_property
    def height_m(self) -> Array:
        inside = 1.0 - np.minimum(self._place.min(axis=0), 1.0) ** 2
        relief = 0.3 * np.sin(self.nodes[:, 0] * 400.0) * np.cos(self.nodes[:, 1] * 300.0)
        top = np.array([one[4] for one in ISLANDS])[self._place.argmin(axis=0)]
        return np.asarray(top * inside * (1.0 + relief) + 30.0)

    @cached_property
    def _place(self) -> Array:
        """Distance (islands, n) of nodes from the middle of islands, 1 at the shore."""
        out = []
        for lon, lat, east_km, north_km, _ in ISLANDS:
            scale = metres_per_degree_at(np.array([[lon, lat, 0.0]]))[0] / 1000.0
            out.append(np.hypot(*((self.nodes - [lon, lat]) * scale / [east_km, north_km]).T))
        return np.array(out)

    def terrain(self, error_m: Array) -> Terrain:
        """The heights with errors (n,) of the nodes."""
        heights = (self.height_m + error_m).reshape(self.grid.shape)
        return Terrain(self.grid, ArrayImage(heights.astype(np.float32)))


@cache
def ground() -> Ground:
    return Ground.around_all()


@cache
def views() -> tuple[Image, ...]:
    """The images that are not ortho-images: five pairs, and seven that show the sites."""
    out = []
    middles = ((-24.97, 16.9), (-22.93, 16.8), (-22.85, 15.95), (-23.4, 15.0), (-24.5, 14.9))
    for number, middle in enumerate(middles):
        out += [
            _pushbroom(f"stereo {number + 1}{side}", STEREO, middle, 20.0, azimuth)
            for side, azimuth in (("a", 16.0), ("b", 196.0))
        ]
    fine = (
        ((-25.05, 16.85), 12.0, 100.0),
        ((-25.05, 16.85), 15.0, 280.0),
        ((-23.5, 15.0), 14.0, 100.0),
        ((-23.5, 15.0), 10.0, 280.0),
        ((-22.95, 16.75), 12.0, 280.0),
        ((-22.92, 16.44), 13.0, 100.0),
        ((-22.88, 16.15), 16.0, 280.0),
    )
    for number, (middle, incidence, azimuth) in enumerate(fine):
        # The sixth is long enough for two sites.
        kind = replace(FINE, shape=(62_000, FINE.shape[1])) if number == 5 else FINE
        out.append(_pushbroom(f"fine {number + 1}", kind, middle, incidence, azimuth))
    return tuple(out)


def _pushbroom(
    name: str, kind: Kind, lon_lat: tuple[float, float], incidence_deg: float, azimuth_deg: float
) -> Image:
    target, heights_m = np.array([*lon_lat, 300.0]), (-100.0, 3000.0)
    true = pushbroom_over(target, kind.shape, kind.gsd_m, (incidence_deg, azimuth_deg), heights_m)
    return Image(name, kind, fit_rpc(true, kind.shape, heights_m).model)


def orthos(terrain: Terrain) -> tuple[Image, ...]:
    """Three ortho-images of two orbits side by side, the eastern one at two dates."""
    out = []
    for number, east_m in enumerate((_WEST_M, _WEST_M + _ORBITS_M, _WEST_M + _ORBITS_M)):
        step = np.array([[0.0, ORTHO.gsd_m], [-ORTHO.gsd_m, 0.0]])
        half_m = np.array(ORTHO.shape) / 2.0 * ORTHO.gsd_m
        grid = MapGrid(
            "EPSG:32626", np.array([east_m, _MIDDLE_M]) + [-half_m[1], half_m[0]], step, ORTHO.shape
        )
        # North up: lines go south, samples east.
        along = np.array([0.0, -_ACROSS[1] * half_m[0], _ACROSS[0] * half_m[1]]) / _HALF_SWATH_M
        displacement = ReliefDisplacement(partial(_or_sea, terrain), _TANGENT * np.outer(_ACROSS, along))
        out.append(Image(f"ortho {number + 1}", ORTHO, OrthoModel(grid, displacement=displacement)))
    return tuple(out)


def _or_sea(terrain: Terrain, lon_lat: Array) -> Array:
    """Heights (n,), 0 beyond the terrain."""
    return np.nan_to_num(terrain.height_m(lon_lat))


def across_m(grid: MapGrid, lon_lat: Array) -> Array:
    """Distance (n,) of points to the right of the middle of the swath of an ortho-image."""
    middle_m = grid.xy((np.array([grid.shape]) - 1.0) / 2.0)
    return np.asarray((grid.xy(grid.line_sample(lon_lat)) - middle_m) @ _ACROSS)


def draw(rng: np.random.Generator, ties: int = TIES) -> Draw:
    """One draw: errors of images and terrain, what is observed, what is known."""
    land = ground()
    of_island = rng.normal(0.0, ISLAND_SIGMA_M, len(ISLANDS))
    error_m = np.where(land.island >= 0, of_island[land.island], 0.0)
    error_m = error_m + rng.normal(0.0, POINT_SIGMA_M, len(error_m))
    terrain = land.terrain(error_m)
    nodes = rng.choice(np.flatnonzero(land.island >= 0), ties, replace=False)
    places = [_site_points(np.array(site), rng) for site in SITES.values()]
    truth = np.concatenate([np.column_stack([land.nodes[nodes], land.height_m[nodes]]), *places])
    site = np.concatenate([np.full(ties, -1), np.repeat(np.arange(len(SITES)), SITE_POINTS)])
    images = (*orthos(terrain), *views())
    rows, delivered = [], []
    for number, image in enumerate(images):
        kind = image.kind
        own = image_parameters(
            image.name,
            image.model,
            kind.shape,
            shift_px=kind.shift_m / kind.gsd_m,
            slope_px=kind.slope_m / kind.gsd_m,
        )
        delivered.append(own)
        exact = _true_position(image, truth, terrain)
        moved = own.corrected(rng.normal(0.0, own.sigma)).correction.apply(exact)
        inside = ((exact > 0.0) & (exact < np.array(kind.shape) - 1.0)).all(axis=1)
        if isinstance(image.model, OrthoModel):
            inside &= np.abs(across_m(image.model.grid, truth[:, :2])) < _HALF_SWATH_M
        seen = inside & (rng.random(len(truth)) < SEEN)
        # Sites are measured in the fine images alone.
        seen = np.where(site >= 0, inside & image.name.startswith("fine"), seen)
        measured = moved[seen] + rng.normal(0.0, kind.noise_px, (int(seen.sum()), 2))
        wrong = (rng.random(len(measured)) < BLUNDERS) & (site[seen] < 0)
        measured[wrong] += rng.uniform(-BLUNDER_PX, BLUNDER_PX, (int(wrong.sum()), 2))
        at = np.flatnonzero(seen)
        sigma = np.full(len(at), kind.noise_px)
        rows.append(np.column_stack([at, np.full(len(at), number), measured, sigma]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    observations = Observations(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:4], table[:, 4]
    )
    return Draw(
        tuple(delivered),
        tuple(image.kind for image in images),
        observations,
        truth,
        site,
        _heights(terrain, truth[:ties], land.island[nodes]),
        tuple(
            KnownSite(name, _known_site(name, truth, site == row, rng)) for row, name in enumerate(SITES)
        ),
    )


def _true_position(image: Image, truth: Array, terrain: Terrain) -> Array:
    """Image position of points; in ortho-images by the error of their terrain, without their model."""
    if not isinstance(image.model, OrthoModel):
        return image.model.project(truth)
    grid = image.model.grid
    tangent = _TANGENT * across_m(grid, truth[:, :2]) / _HALF_SWATH_M
    off_m = (truth[:, 2] - terrain.height_m(truth[:, :2])) * tangent
    step = np.column_stack([off_m[:, None] * _ACROSS, np.zeros(len(truth))])
    return grid.line_sample(move_metres(truth, step)[:, :2])


def _site_points(lon_lat: Array, rng: np.random.Generator) -> Array:
    east_north = rng.uniform(-1500.0, 1500.0, (SITE_POINTS, 2))
    enu = np.column_stack([east_north, rng.uniform(0.0, 20.0, SITE_POINTS)])
    return lon_lat_h_from_east_north_up(enu, np.array([*lon_lat, 50.0]))


def _known_site(name: str, truth: Array, members: BoolArray, rng: np.random.Generator) -> ControlGround:
    point = np.flatnonzero(members)
    error_m = rng.normal(0.0, SITE_OWN_M, (len(point), 3)) + rng.normal(0.0, SITE_FRAME_M, 3)
    return ControlGround(
        point=point,
        lon_lat_h=move_metres(truth[point], error_m),
        covariance_m2=np.tile(np.eye(3) * SITE_OWN_M**2, (len(point), 1, 1)),
        source=np.zeros(len(point), dtype=np.int64),
        frames=(Frame.from_sigmas(SITE_FRAME_M, SITE_FRAME_M),),
        names=tuple(f"{name} {number + 1}" for number in range(len(point))),
    )


def _heights(terrain: Terrain, truth: Array, island: IntArray) -> ControlGround:
    """The heights of the terrain at points, with an error of each island."""
    covariance_m2 = np.tile(np.diag([np.inf, np.inf, POINT_SIGMA_M**2]), (len(truth), 1, 1))
    return ControlGround(
        point=np.arange(len(truth), dtype=np.int64),
        lon_lat_h=np.column_stack([truth[:, :2], terrain.height_m(truth[:, :2])]),
        covariance_m2=covariance_m2,
        source=island.astype(np.int64),
        frames=tuple(Frame.from_sigmas(np.nan, ISLAND_SIGMA_M) for _ in ISLANDS),
        names=tuple(f"height {number + 1}" for number in range(len(truth))),
    )
