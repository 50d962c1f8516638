"""Planning of a block: the accuracy of images and sites before they exist, and where control helps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.planning import PredictedBlock, predicted_block
from amers.services.production.block_plan import (
    BlockPlan,
    PlanGeometry,
    PlannedSite,
    observed_and_known,
    plan_geometry,
)
from amers.services.quality.normal_law import LINEAR_LE90, normal_ce90
from amers.services.types import Array, IntArray, Progress, no_progress


@dataclass(frozen=True)
class Accuracy90:
    """CE90 and LE90 in metres: mean over some ground, and the largest."""

    ce90_m: float
    le90_m: float
    worst_ce90_m: float
    worst_le90_m: float


@dataclass(frozen=True)
class ImageForecast:
    """Accuracy of the points of one image.

    Attributes:
        name: of the image.
        points: that it shows, with another image or a known position.
        relative, on_the_earth: without and with the frame of the block.
    """

    name: str
    points: int
    relative: Accuracy90
    on_the_earth: Accuracy90


@dataclass(frozen=True)
class ProposedSite:
    """The site whose addition lowers the mean CE90 of the ground most.

    Attributes:
        site: the proposal.
        on_the_earth: of the ground, with it and those proposed before.
        gain_m: (c,) by how much each candidate lowers the mean CE90; NaN where no image shows it, or
            where it is proposed already.
    """

    site: PlannedSite
    on_the_earth: Accuracy90
    gain_m: Array


@dataclass(frozen=True)
class Forecast:
    """What a plan gives.

    Attributes:
        lon_lat: (p, 2) places of the ground that two images show.
        ce90_m, le90_m: (p,) on the Earth.
        relative, on_the_earth: of this ground.
        images: each of them.
        groups: number of groups of images that points tie together.
        proposed: sites to add, in order.
    """

    lon_lat: Array
    ce90_m: Array
    le90_m: Array
    relative: Accuracy90
    on_the_earth: Accuracy90
    images: tuple[ImageForecast, ...]
    groups: int
    proposed: tuple[ProposedSite, ...]


def forecast(plan: BlockPlan, progress: Progress = no_progress) -> Forecast:
    """The accuracy of a plan, and the sites that would improve it most.

    Each candidate is added in turn and the covariance of the block computed again; the best one stays,
    and the others are tried beside it.

    Raises:
        InputError: the plan cannot be computed.
        NotEnoughPoints: the images have too little in common.
        DisconnectedBlock: groups of images without common points, and without control of each.
    """
    geometry = plan_geometry(plan)
    known = list(range(len(plan.sites)))
    begun = block_of(plan, geometry, known)
    ground = np.flatnonzero((geometry.site < 0) & (begun.group >= 0))
    proposed = []
    left = list(range(len(plan.candidates)))
    rounds = min(plan.added, len(left))
    before = summary(begun, ground)[1].ce90_m if rounds else np.nan
    for number in range(rounds):
        gain_m = np.full(len(plan.candidates), np.nan)
        best: tuple[float, Accuracy90] | None = None
        for k, candidate in enumerate(left):
            row = len(plan.sites) + candidate
            if np.isin(geometry.observations.point, np.flatnonzero(geometry.site == row)).any():
                earth = summary(block_of(plan, geometry, [*known, row]), ground)[1]
                gain_m[candidate] = before - earth.ce90_m
                if best is None or gain_m[candidate] > best[0]:
                    best, chosen = (float(gain_m[candidate]), earth), candidate
            progress((number + k / len(left)) / rounds, f"site {number + 1} of {rounds}")
        if best is None:
            break
        proposed.append(ProposedSite(plan.candidates[chosen], best[1], gain_m))
        known.append(len(plan.sites) + chosen)
        left.remove(chosen)
        before = best[1].ce90_m
    relative, on_the_earth = summary(begun, ground)
    earth_m2 = begun.on_earth_m2()[ground]
    return Forecast(
        lon_lat=geometry.lon_lat_h[ground, :2],
        ce90_m=normal_ce90(earth_m2[:, :2, :2]),
        le90_m=LINEAR_LE90 * np.sqrt(earth_m2[:, 2, 2]),
        relative=relative,
        on_the_earth=on_the_earth,
        images=tuple(_of_image(geometry, begun, ground, k) for k in range(len(geometry.images))),
        groups=len(begun.frames),
        proposed=tuple(proposed),
    )


def block_of(plan: BlockPlan, geometry: PlanGeometry, known: Sequence[int]) -> PredictedBlock:
    """The block where some of the sites and candidates are known; the others are not observed."""
    observations, control = observed_and_known(plan, geometry, known)
    return predicted_block(
        geometry.images, observations, geometry.lon_lat_h, control=control, passes=geometry.pass_members
    )


def summary(block: PredictedBlock, rows: IntArray) -> tuple[Accuracy90, Accuracy90]:
    """Accuracy of some points, relative to the frame of the block and on the Earth."""
    parts = block.point_covariance_m2[rows], block.on_earth_m2()[rows]
    out = []
    for covariance_m2 in parts:
        ce90_m = normal_ce90(covariance_m2[:, :2, :2])
        le90_m = LINEAR_LE90 * np.sqrt(covariance_m2[:, 2, 2])
        figures = (ce90_m.mean(), le90_m.mean(), ce90_m.max(), le90_m.max())
        out.append(Accuracy90(*(float(one) for one in figures)))
    return out[0], out[1]


def _of_image(
    geometry: PlanGeometry, block: PredictedBlock, ground: IntArray, number: int
) -> ImageForecast:
    own = geometry.observations.point[geometry.observations.image == number]
    rows = np.intersect1d(own, ground)
    unknown = Accuracy90(np.nan, np.nan, np.nan, np.nan)
    figures = summary(block, rows) if len(rows) else (unknown, unknown)
    return ImageForecast(geometry.images[number].name, len(rows), *figures)
