"""The statement of accuracy, in the same words in every report, command, page and document.

Two figures, in this order: relative to the control points, and on the Earth. The second includes the
frame of the control points, an error that all of them share and that no registration on them can show.
"""

from dataclasses import asdict, dataclass

import numpy as np

from amers.services.quality.frames import frame_le90_m, why_unknown
from amers.services.quality.normal_law import LINEAR_LE90, normal_ce90
from amers.services.types import Array, Frame

RELATIVE = "Relative to the control points"
ON_THE_EARTH = "On the Earth"
_WORST_PLACE = "worst place of the image"


@dataclass(frozen=True)
class StatedAccuracy:
    """Accuracy against one reference.

    Attributes:
        label: the reference, "Relative to the control points" or "On the Earth".
        ce90_m: horizontal, of the normal law; null when unknown.
        le90_m: of the height, of the normal law; null when unknown or when there are no heights.
        words: both figures as text, with what is unknown and why.
    """

    label: str
    ce90_m: float
    le90_m: float
    words: str


@dataclass(frozen=True)
class AccuracyStatement:
    """The accuracy of a registered scene or of control points.

    Attributes:
        relative_to_control_points: without the frame of the control points.
        on_the_earth: with it.
    """

    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy

    @property
    def words(self) -> dict[str, str]:
        """The two figures as text, by their labels."""
        return {one.label: one.words for one in (self.relative_to_control_points, self.on_the_earth)}

    @property
    def lines(self) -> tuple[str, ...]:
        """The two figures as text, each with its label."""
        return tuple(f"{label}: {words}" for label, words in self.words.items())


def scene_accuracy(
    relative_m: float, on_the_earth_m: float, frame: Frame, held_percent: float
) -> AccuracyStatement:
    """The statement for a registered scene.

    CE90 is that of the ground where the model puts a pixel, when the true height of the ground is known.
    A scene gives no heights. Heights that several scenes registered on the same points give have the
    error of the frame in any case: its LE90 is stated on the Earth.

    Args:
        relative_m: CE90 at the worst place that points support, relative to the control points.
        on_the_earth_m: the same with the frame of the control points; NaN when unknown.
        frame: of the control points.
        held_percent: share of the image that points support.
    """
    le90_m = frame_le90_m(frame)
    height = f"LE90 of the control points' common error {_metres(le90_m)}"
    place = f"(worst place of the {_percent(held_percent)} of the image that points support)"
    if held_percent == 100.0:
        place = "(worst place of the image)"
    return AccuracyStatement(
        StatedAccuracy(RELATIVE, relative_m, np.nan, f"CE90 {_metres(relative_m)} {place}"),
        StatedAccuracy(
            ON_THE_EARTH,
            on_the_earth_m,
            le90_m,
            _with_reason(f"CE90 {_metres(on_the_earth_m)} {place}, {height}", frame),
        ),
    )


def _percent(share: float) -> str:
    """A share in whole percent: all of it is 100, and nothing 0, without rounding."""
    whole = round(share) if share in (0.0, 100.0) else min(max(round(share), 1), 99)
    return f"{whole} %"


def points_accuracy(covariance_m2: Array, frame: Frame, of: str) -> AccuracyStatement:
    """The statement for control points.

    Args:
        covariance_m2: (3, 3) of east, north, up of a point in the frame of its block.
        frame: of the block.
        of: which point that is, for people.
    """
    relative, relative_words = _point_figures(covariance_m2, of)
    earth, earth_words = _point_figures(covariance_m2 + frame.covariance_m2, of)
    return AccuracyStatement(
        StatedAccuracy(RELATIVE, *relative, relative_words),
        StatedAccuracy(ON_THE_EARTH, *earth, _with_reason(earth_words, frame)),
    )


def median_accuracy(horizontal_m: float, up_m: float, frame: Frame) -> AccuracyStatement:
    """The statement for the median point of a block, by its standard deviations of a coordinate."""
    covariance_m2 = np.diag(np.array([horizontal_m, horizontal_m, up_m]) ** 2)
    return points_accuracy(covariance_m2, frame, "median of the points")


def vertices_accuracy(
    relative_m: Array, on_the_earth_m: Array, frame: Frame | None
) -> AccuracyStatement:
    """The statement for vertices that were located through the model of a scene and a terrain.

    Args:
        relative_m: CE90 (n,) of the vertices relative to the control points; NaN when unknown, such as
            beyond the area that points support.
        on_the_earth_m: the same with the frame of the control points.
        frame: of the control points; None for a scene that is not registered.
    """
    worst_m, worst_on_the_earth_m = (_worst_known(one) for one in (relative_m, on_the_earth_m))
    relative, earth = (_of_vertices(one) for one in (relative_m, on_the_earth_m))
    if frame is None:
        relative = "none: the scene is not registered"
        if np.isnan(worst_on_the_earth_m):
            earth = f"{earth}: the scene is not registered, and the accuracy of its model is not stated"
    else:
        earth = _with_reason(earth, frame)
    return AccuracyStatement(
        StatedAccuracy(RELATIVE, worst_m, np.nan, relative),
        StatedAccuracy(ON_THE_EARTH, worst_on_the_earth_m, np.nan, earth),
    )


def no_accuracy(reason: str) -> AccuracyStatement:
    """The statement where there is no accuracy, such as for a scene that could not be registered."""
    words = f"none: {reason}"
    return AccuracyStatement(
        StatedAccuracy(RELATIVE, np.nan, np.nan, words),
        StatedAccuracy(ON_THE_EARTH, np.nan, np.nan, words),
    )


def _point_figures(covariance_m2: Array, of: str) -> tuple[tuple[float, float], str]:
    """CE90 and LE90 of a covariance (3, 3), and their words."""
    ce90_m = float(normal_ce90(covariance_m2[None, :2, :2])[0])
    le90_m = LINEAR_LE90 * float(np.sqrt(covariance_m2[2, 2]))
    return (ce90_m, le90_m), f"CE90 {_metres(ce90_m)}, LE90 {_metres(le90_m)} ({of})"


def accuracy_document(statement: AccuracyStatement) -> dict[str, dict[str, str | float | None]]:
    """The statement as JSON values, null where a figure is unknown: members of many documents."""
    return {
        name: {key: None if value != value else value for key, value in asdict(stated).items()}
        for name, stated in vars(statement).items()
    }


def _worst_known(values_m: Array) -> float:
    return float(np.nanmax(values_m)) if np.isfinite(values_m).any() else float("nan")


def _of_vertices(ce90_m: Array) -> str:
    worst_m = _worst_known(ce90_m)
    if np.isnan(worst_m):
        return "CE90 unknown"
    median_m = _metres(float(np.nanmedian(ce90_m)))
    words = f"CE90 {_metres(worst_m)} (worst vertex), {median_m} (median vertex)"
    unknown = int(np.isnan(ce90_m).sum())
    if not unknown:
        return words
    return (
        f"{words}; unknown for {unknown} of {len(ce90_m)} vertices, beyond the area of the image that "
        "control points support, or where a line of sight grazes the ground"
    )


def _with_reason(words: str, frame: Frame) -> str:
    assumed = f"assumed: {frame.assumed}" if frame.assumed else ""
    reason = why_unknown(frame) or assumed
    return f"{words}: {reason}" if reason else words


def _metres(value_m: float) -> str:
    return f"{value_m:.2f} m" if np.isfinite(value_m) else "unknown"
