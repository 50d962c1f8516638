"""Models of marks that are being set in a scene."""

from typing import Literal

from amers.app.api.models.base import Reply, StatedAccuracy

Pixels = list[float | None]


class AdjustedMark(Reply):
    """A mark after the adjustment, or a check point, which has no part in it.

    Line, sample and height are as used, sigmas one standard deviation: of the ground east, north, up;
    of the pick. Residuals are observed minus computed, line and sample; `left_out_px` is against the
    model without this mark. They are null where the model has no position.
    """

    name: str
    line: float
    sample: float
    lon: float
    lat: float
    height_m: float | None
    sigma_m: list[float | None]
    sigma_px: float | None
    residual_px: Pixels
    residual_m: float | None
    left_out_px: Pixels
    status: Literal["used", "rejected", "in doubt", "check"]
    note: str


class PlaceOfMarks(Reply):
    """A place in the image and on the ground, by the adjusted model; null where there is none.

    `sigma_px` is one standard deviation of the place in the image; `is_height_known` is false where the
    height is that of other marks, or the middle one of the model.
    """

    line: float | None
    sample: float | None
    lon: float | None
    lat: float | None
    height_m: float | None
    sigma_px: float | None
    is_height_known: bool


class AdjustedMarks(Reply):
    """What marks say of the model of a scene: as `register-scene` would on them alone.

    `terrain` is the name of the reference whose terrain gives heights, null without one. Verdict and
    accuracy are null without a mark that is no check point.
    """

    marks: list[AdjustedMark]
    verdict: Literal["good", "usable", "failed"] | None
    relative_to_control_points: StatedAccuracy | None
    on_the_earth: StatedAccuracy | None
    words: list[str]
    next_mark: PlaceOfMarks | None
    places: list[PlaceOfMarks]
    terrain: str | None
