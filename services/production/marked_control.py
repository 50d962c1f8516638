"""Control from ground points that people marked in images: typed in, or imported."""

from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.statements import Statements
from amers.services.types import Array, Frame, Observations


@dataclass(frozen=True)
class MarkedGround:
    """Ground points and where people saw them.

    Attributes:
        names: of the n points, for messages and reports.
        lon_lat_h: (n, 3); the height is NaN where unknown.
        sigma_m: (n, 3) of east, north, up, one standard deviation, relative to the frame.
        frame: error on the Earth that all of them share.
        marks: their positions in images.
        statements: of their files.
    """

    names: tuple[str, ...]
    lon_lat_h: Array
    sigma_m: Array
    frame: Frame
    marks: Observations
    statements: Statements = ()


def known_marks(marked: MarkedGround, first_point: int) -> tuple[Observations, ControlGround]:
    """Marked points as observations and known ground.

    Args:
        marked: the points; `marks.image` are rows of the images of the block.
        first_point: number of the first point of the observations.
    """
    height_unknown = np.isnan(marked.lon_lat_h[:, 2])
    variance_m2 = marked.sigma_m**2
    variance_m2[height_unknown, 2] = np.inf
    count = len(marked.names)
    covariance_m2 = np.zeros((count, 3, 3))
    covariance_m2[:, range(3), range(3)] = variance_m2
    ground = ControlGround(
        point=first_point + np.arange(count),
        lon_lat_h=marked.lon_lat_h,
        covariance_m2=covariance_m2,
        source=np.zeros(count, dtype=np.int64),
        frames=(marked.frame,),
        names=marked.names,
        by_hand=np.ones(count, dtype=np.bool_),
    )
    marks = marked.marks
    observations = Observations(
        first_point + marks.point, marks.image, marks.line_sample, marks.sigma_px
    )
    return observations, ground
