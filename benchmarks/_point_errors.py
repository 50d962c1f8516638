"""Errors of control points and of the blocks that they come from."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.geodesy import metres_per_degree, move_metres
from amers.services.quality.normal_law import CIRCULAR_CE90
from amers.services.types import Array, ControlPoints, Frame, IntArray
from benchmarks._trials import Trial
from benchmarks._worlds import FINE_GSD_M

LE90_OF_CE90 = 5.0 / 3.0
"""Ratio of the points: 5 m to 3 m in SRP."""
STRIP_WARP_M = (0.9, 3.4)
"""Horizontal and vertical distortion of a strip at the ends of a scene, when a trial is warped by 1."""
_WAVES = 200


@dataclass(frozen=True)
class BlockErrors:
    """Where blocks lie on the Earth: what all their points share.

    Attributes:
        offset_m: (b, 3) east, north, up of each block.
        warp_m: (2, 3) amplitudes, linear and quadratic, of a distortion along `direction`.
        direction: (2,) east and north, of unit length.
        centre_lon_lat: (2,) of the scene, degrees.
        half_side_m: of the scene.
    """

    offset_m: Array
    warp_m: Array
    direction: Array
    centre_lon_lat: Array
    half_side_m: float

    def along(self, lon_lat: Array) -> Array:
        """Positions (n,) along the direction, -1 to 1 over the scene."""
        per_degree = np.array(metres_per_degree(float(self.centre_lon_lat[1]), 0.0))
        east_north = (lon_lat[:, :2] - self.centre_lon_lat) * per_degree
        return np.asarray(east_north @ self.direction / self.half_side_m)

    def warp_at(self, lon_lat_h: Array) -> Array:
        """Distortion (n, 3) at places, metres."""
        t = np.clip(self.along(lon_lat_h), -1.5, 1.5)
        return np.asarray(np.column_stack([t, 1.5 * t**2 - 0.5]) @ self.warp_m)

    def in_frame(self, lon_lat_h: Array, used: IntArray) -> Array:
        """True ground (n, 3) where the points used say that it is: distorted, and moved by their frame.

        The frame of points of one block is its offset. Several blocks scatter about the Earth: what they
        disagree by is an error relative to the points.

        Args:
            lon_lat_h: (n, 3) on the Earth.
            used: (k,) blocks of the points that are used.
        """
        blocks = np.unique(used)
        frame_m = self.offset_m[blocks[0]] if len(blocks) == 1 else np.zeros(3)
        return move_metres(lon_lat_h, frame_m + self.warp_at(lon_lat_h))


def spoil(
    points: ControlPoints,
    trial: Trial,
    centre_lon_lat: Array,
    side_m: float,
    *,
    rng: np.random.Generator,
    more: np.random.Generator,
) -> tuple[ControlPoints, BlockErrors]:
    """Points with the errors of a trial, and those of their blocks.

    They are noise, which may be correlated, offsets and distortions of blocks, moved points and chips
    of other points.

    Args:
        points: as measured, of one true block.
        trial: what is done to them, and declared.
        centre_lon_lat: (2,) of the scene, degrees.
        side_m: of the scene.
        rng: source of the errors that the ordinary scenes have.
        more: source of the others.
    """
    n = len(points)
    horizontal_m = rng.normal(0.0, trial.frame_sigma_m, 2)
    errors = _block_errors(trial, horizontal_m, centre_lon_lat, side_m, more)
    block = _blocks(trial, errors, points, more)
    sigma_m = trial.point_ce90_m * np.array(
        [1.0 / CIRCULAR_CE90, 1.0 / CIRCULAR_CE90, LE90_OF_CE90 / 1.6449]
    )
    noise = rng.standard_normal((n, 3))
    if trial.correlated > 0.0:
        field = _field(points.lon_lat_h, errors, trial.correlation, more)
        noise = np.sqrt(1.0 - trial.correlated) * noise + np.sqrt(trial.correlated) * field
    offset_m = errors.offset_m[block] + trial.understated * sigma_m * noise
    offset_m += errors.warp_at(points.lon_lat_h)
    order = rng.permutation(n)
    moved, vanished = np.split(order, [round(trial.moved * n)])
    vanished = vanished[: round(trial.vanished * n)]
    far_m = rng.uniform(2.0, 20.0, len(moved)) * max(FINE_GSD_M, trial.gsd_m)
    towards = rng.uniform(0.0, 2.0 * np.pi, len(moved))
    offset_m[moved, :2] += far_m[:, None] * np.column_stack([np.sin(towards), np.cos(towards)])
    chip_row = points.chip_row.copy()
    chip_row[vanished] = np.roll(chip_row[vanished], 1)
    spoiled = replace(
        points,
        lon_lat_h=move_metres(points.lon_lat_h, offset_m),
        covariance_m2=points.covariance_m2 + np.diag(sigma_m**2),
        block=block,
        frames=(_declared(trial),) * trial.blocks,
        chip_row=chip_row,
    )
    return spoiled, errors


def _block_errors(
    trial: Trial, horizontal_m: Array, centre_lon_lat: Array, side_m: float, more: np.random.Generator
) -> BlockErrors:
    sigma_m = np.array([trial.frame_sigma_m, trial.frame_sigma_m, trial.frame_up_m])
    offset_m = sigma_m * more.standard_normal((trial.blocks, 3))
    offset_m[0, :2] = horizontal_m
    towards, cut, mix = more.uniform(0.0, 2.0 * np.pi, 3)
    across, up = STRIP_WARP_M
    amplitude_m = trial.warped * np.array([across * np.sin(cut), across * np.cos(cut), up])
    return BlockErrors(
        offset_m=offset_m,
        warp_m=np.outer([np.cos(mix), np.sin(mix)], amplitude_m),
        direction=np.array([np.sin(towards), np.cos(towards)]),
        centre_lon_lat=centre_lon_lat,
        half_side_m=side_m / 2.0,
    )


def _blocks(
    trial: Trial, errors: BlockErrors, points: ControlPoints, more: np.random.Generator
) -> IntArray:
    """The block of each point: parts of the scene side by side along a direction."""
    along = errors.along(points.lon_lat_h)
    cuts = {1: (), 2: ((0.3, 0.7),), 3: ((0.2, 0.4), (0.6, 0.8))}[trial.blocks]
    edges = [2.0 * more.uniform(low, high) - 1.0 for low, high in cuts]
    return np.searchsorted(edges, along).astype(np.int64)


def _field(
    lon_lat_h: Array, errors: BlockErrors, correlation: float, more: np.random.Generator
) -> Array:
    """Three normal fields (n, 3) of unit variance whose correlation falls as a Gaussian of the distance.

    Each is a sum of waves of random directions (Rahimi and Recht, 2007).

    Args:
        lon_lat_h: (n, 3) places.
        errors: gives the scene.
        correlation: length of the correlation, as a share of the side of the scene.
        more: source of the waves.
    """
    per_degree = np.array(metres_per_degree(float(errors.centre_lon_lat[1]), 0.0))
    length_m = 2.0 * errors.half_side_m * correlation
    place = (lon_lat_h[:, :2] - errors.centre_lon_lat) * per_degree / length_m
    phase = more.uniform(0.0, 2.0 * np.pi, (3, _WAVES))
    wave = more.standard_normal((3, 2, _WAVES))
    return np.stack(
        [np.sqrt(2.0 / _WAVES) * np.cos(place @ wave[k] + phase[k]).sum(axis=1) for k in range(3)],
        axis=1,
    )


def _declared(trial: Trial) -> Frame:
    """The frame that a producer declares: what offset and distortion are on average, over the block."""
    across, up = STRIP_WARP_M
    warp_m2 = trial.warped**2 * np.array([across**2 / 2.0, across**2 / 2.0, up**2]) / 4.0
    frame_m2 = np.array([trial.frame_sigma_m, trial.frame_sigma_m, trial.frame_up_m]) ** 2
    return Frame(np.diag(frame_m2 + warp_m2))
