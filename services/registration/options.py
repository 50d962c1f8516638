"""Options of a registration: body of a request, and record in the report."""

from dataclasses import dataclass, field

from amers.services.errors import InputError
from amers.services.matching.control_points import MatchingOptions
from amers.services.matching.reference_image import ReferenceMatchingOptions
from amers.services.misfit.scene_adjustment import AdjustmentOptions
from amers.services.quality.qualification import QualificationOptions


@dataclass(frozen=True)
class CoarseOptions:
    """Options of the coarse search: few points, far out.

    Attributes:
        max_fine_radius_px: a search radius up to this many pixels of the fine chips needs no coarse
            search.
        points: number of points to try that the scene is expected to show whole, wherever it lies.
        enough: number of chips of one ground sampling that the scene should show whole, and number of
            them that must fit into it side by side, for that ground sampling to be used.
        min_score: normalised correlation below which a chip is not found; the consensus of many points
            decides which of these matches are right.
        max_search_px: largest search radius around single points, pixels of their chips; further out,
            the whole scene is searched.
        max_reduction: largest reduction of a chip; below 25 pixels a chip is hardly distinctive.
        max_false_alarms: a scene whose first searches, all together, have more expected false alarms
            than this is refused.
    """

    max_fine_radius_px: int = 24
    points: int = 60
    enough: int = 12
    min_score: float = 0.5
    max_search_px: int = 400
    max_reduction: int = 4
    max_false_alarms: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse values that allow no search."""
        for name in ("points", "max_search_px", "max_reduction"):
            _check_at_least(1, name, getattr(self, name))


@dataclass(frozen=True)
class ReferenceOptions:
    """Options of a registration on a reference ortho-image.

    Attributes:
        places: number of places searched at the finest level, evenly over the scene.
        leading_places: number of places searched at the coarser levels; where less than a quarter of
            them agree, `places` are searched.
        first_radius_px: the first level is so coarse that three standard deviations of the model are
            at most this many of its pixels.
        fine_stages: largest number of searches at the finest level, each through the last model.
        settled_px: a search at the finest level that moves every corner of the image by at most this
            many pixels of the level is the last.
        enough: smallest number of windows side by side that the scene must hold at a level.
        max_false_alarms: a first consensus with more expected false alarms than this is refused.
        matching: how places are searched.
    """

    places: int = 900
    leading_places: int = 100
    first_radius_px: int = 16
    fine_stages: int = 2
    settled_px: float = 0.25
    enough: int = 12
    max_false_alarms: float = 1e-4
    matching: ReferenceMatchingOptions = field(default_factory=ReferenceMatchingOptions)

    def __post_init__(self) -> None:
        """Refuse values that allow no registration."""
        for name in ("places", "leading_places", "first_radius_px", "fine_stages", "enough"):
            _check_at_least(1, name, getattr(self, name))


@dataclass(frozen=True)
class RegistrationOptions:
    """Options of a registration, on control points or on a reference image.

    Attributes:
        max_points: largest number of points tried, well spread over the image; 0 tries all points.
        fine_stages: number of searches with the fine chips, each through the last model.
        seed: of the random draws of the stability test.
        coarse: of the coarse search.
        matching: how points are searched.
        adjustment: of the correction.
        qualification: thresholds of the verdict.
        reference: of a registration on a reference image.
    """

    max_points: int = 500
    fine_stages: int = 2
    seed: int = 0
    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    adjustment: AdjustmentOptions = field(default_factory=lambda: AdjustmentOptions(min_points=6))
    qualification: QualificationOptions = field(default_factory=QualificationOptions)
    reference: ReferenceOptions = field(default_factory=ReferenceOptions)

    def __post_init__(self) -> None:
        """Refuse values that allow no registration."""
        _check_at_least(0, "max_points", self.max_points)
        _check_at_least(1, "fine_stages", self.fine_stages)


def _check_at_least(smallest: int, name: str, value: int) -> None:
    if value < smallest:
        raise InputError(f"{name}: {value} given, {smallest} or more expected")
