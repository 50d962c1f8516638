"""The context of a registration, common to all its stages, and the current prediction."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import CachedImage
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Array, ChipSource, ControlPoints, IntArray, Progress, part_of


@dataclass(frozen=True)
class NotFound:
    """Number of points that a search did not find, for one reason.

    Attributes:
        reason: code of the matching.
        count: number of points.
    """

    reason: str
    count: int


@dataclass(frozen=True)
class Candidate:
    """A group of matches that agree on one displacement.

    Attributes:
        points: number of matches.
        east_m, north_m: their mean displacement from the expected positions.
        false_alarms: number of such groups that chance alone makes, see `a_contrario_consensus`.
    """

    points: int
    east_m: float
    north_m: float
    false_alarms: float


@dataclass(frozen=True)
class SearchStage:
    """Summary of one search of the points through one model.

    Attributes:
        name: "far", "coarse" or "fine" on control points, "reference" on a reference image.
        chip_gsd_m: ground sampling of the chips that were searched.
        search_radius_m: search radius on the ground.
        needed_radius_m: largest error that was expected; the search was limited where this is more than
            the search radius.
        tried, matched, inliers: numbers of points searched, found, and in agreement with each other.
        at_border: number of points whose best peak lies at the border of the search.
        displacement_rms_m: distance of the inliers from their expected positions, root mean square.
        not_found: numbers of the points that were not found, by reason, commonest first.
        candidates: the largest groups of matches that agree, the largest first; none where most matches
            agree.
        middle_m: side on the ground of the middle of the scene, where the scene was too large to be
            searched whole; NaN when it was.
    """

    name: str
    chip_gsd_m: float
    search_radius_m: float
    needed_radius_m: float
    tried: int
    matched: int
    at_border: int
    inliers: int
    displacement_rms_m: float
    not_found: tuple[NotFound, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    middle_m: float = math.nan

    @property
    def limited(self) -> bool:
        """Whether the search did not reach the largest error that was expected."""
        return self.needed_radius_m > self.search_radius_m


@dataclass(frozen=True)
class RegistrationContext:
    """What a registration works on; every stage receives it.

    Attributes:
        scene: as delivered.
        options: of all stages.
        progress: receives the fraction done and the work under way.
        stages: summaries of the searches so far, in order, also of one that was refused.
        breaks: first lines behind breaks of the image, where lines are missing or repeated; None before
            they are looked for.
    """

    scene: Scene
    options: RegistrationOptions
    progress: Progress
    stages: list[SearchStage]
    breaks: IntArray | None

    @cached_property
    def gsd_m(self) -> float:
        """Ground sampling at the centre of the scene, metres."""
        return scene_gsd_m(self.scene)

    def part(self, start: float, share: float) -> Self:
        """The same context for a part of the work, whose progress runs from `start` over `share`."""
        return replace(self, progress=part_of(self.progress, start, share))

    def parts(self, start: float, share: float, count: int) -> Iterator[Self]:
        """The same context for each of `count` equal parts of the work from `start` over `share`."""
        for number in range(count):
            yield self.part(start + share * number / count, share / count)


@dataclass(frozen=True)
class PointContext(RegistrationContext):
    """What a registration on control points works on.

    Attributes:
        points: all n points that the scene may show.
        chips: of these points.
        image: the pixels of the scene; what one stage reads is kept for the next.
        fine_gsd_m: ground sampling of the chips of the fine searches.
    """

    points: ControlPoints
    chips: ChipSource
    image: CachedImage
    fine_gsd_m: float


@dataclass(frozen=True)
class Prediction:
    """Where a model expects points, and how precisely.

    Attributes:
        model: of the scene, as corrected so far.
        uncertainty_m: (n,) standard deviation of the expected positions, metres.
    """

    model: CorrectedModel
    uncertainty_m: Array
