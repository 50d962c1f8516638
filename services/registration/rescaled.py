"""Images with finer or coarser pixels than their model: the model is of another image.

The model of a panchromatic image beside a colour image, or a delivered model beside an image that was
resampled, place the first pixel right and all others farther off, the farther they lie from it. No shift
is found then, and a search that is made wider takes long and finds nothing.
"""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import ComputationError, CoverageError
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ImageSource, Window
from amers.services.registration.chip_selection import fine_gsd_m
from amers.services.registration.context import RegistrationContext, SearchStage
from amers.services.registration.far import search_far
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_selection import initial_prediction, visible_points
from amers.services.registration.search import largest_error_m
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.types import ChipSource, ControlPoints, FloatImage, no_progress

_FACTORS = {"finer": (2, 4, 3), "coarser": (2, 4, 3)}
"""By how many times the pixels of images and of their models differ: panchromatic and colour images of
most satellites by 4, some by 2 or 3, and images are made smaller by 2."""
_POINTS, _VIEWS = 16, 1
"""Points that the scene is expected to show, and views of each: six scales are searched."""
_AGREEING = 6
_CHIPS_ACROSS, _MAX_SIDE_PX = 12, 4096
"""Chips side by side in the middle of a scene that is searched, and its largest side."""


def rescaled_scene(scene: Scene, factor: float) -> Scene:
    """A scene whose model is that of an image with pixels finer by a factor; the corners stay."""
    frame = no_correction(scene.image.shape)
    shift = (factor - 1.0) * (frame.centre + 0.5)
    slopes = (factor - 1.0) * np.diag(frame.half_size)
    correction = replace(frame, parameters=np.column_stack([shift, slopes]))
    return replace(scene, model=CorrectedModel(scene.model, correction))


def how_it_is_rescaled(
    scene: Scene, points: ControlPoints, chips: ChipSource, options: RegistrationOptions
) -> str:
    """How the pixels of a scene that was not found differ from those of its model; "" if unseen.

    Args:
        scene: that was searched.
        points: around it.
        chips: of the points.
        options: of the registration.
    """
    few = replace(
        options,
        coarse=replace(options.coarse, points=_POINTS),
        matching=replace(options.matching, max_views=_VIEWS),
    )
    for word, factors in _FACTORS.items():
        for factor in factors:
            of = rescaled_scene(scene, factor if word == "finer" else 1.0 / factor)
            agreeing = _agreeing(of, points, chips, few)
            if agreeing >= _AGREEING:
                return (
                    f"the pixels of the image are {factor} times {word} than its model says, by "
                    f"{agreeing} points that agree then; give the model that was delivered with this "
                    "image, or the image of this model"
                )
    return ""


def _agreeing(
    scene: Scene, points: ControlPoints, chips: ChipSource, options: RegistrationOptions
) -> int:
    """Number of points that agree beyond chance in a quick search of the middle; 0 for none."""
    stages: list[SearchStage] = []
    if not _is_located(scene):
        return 0
    try:
        visible = points.take(visible_points(scene, points))
        prediction = initial_prediction(scene, visible)
        gsd_m = fine_gsd_m(scene, visible, prediction)
        reach_m = max(_CHIPS_ACROSS * CHIP_SIZE * gsd_m, 4.0 * largest_error_m(prediction.uncertainty_m))
        middle = _middle(scene, min(int(reach_m / scene_gsd_m(scene)), _MAX_SIDE_PX))
        visible = points.take(visible_points(middle, points))
        prediction = initial_prediction(middle, visible)
        context = RegistrationContext(middle, options, no_progress, stages, None)
        search_far(context, visible, chips, prediction, gsd_m)
    except (CoverageError, ComputationError):
        return 0
    return stages[-1].inliers


def _is_located(scene: Scene) -> bool:
    """Whether the model of a scene reaches its corners: that of a larger image does not."""
    last = np.array(scene.image.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]) * last
    height_m = sum(scene.model.height_range_m) / 2.0
    return bool(np.isfinite(scene.model.locate(corners, np.full(4, height_m))).all())


def _middle(scene: Scene, side: int) -> Scene:
    """The middle of a scene, at most so many lines and samples."""
    size = np.array(scene.image.shape)
    lines, samples = (int(length) for length in np.minimum(size, side))
    first = (size - (lines, samples)) // 2
    frame = no_correction((lines, samples))
    shift = np.column_stack([-first, np.zeros((2, 2))]).astype(np.float64)
    model = CorrectedModel(scene.model, replace(frame, parameters=shift))
    image = _Part(scene.image, int(first[0]), int(first[1]), (lines, samples))
    return replace(scene, image=image, model=model)


@dataclass(frozen=True)
class _Part:
    """A rectangle of an image; an `ImageSource`."""

    image: ImageSource
    line: int
    sample: int
    shape: tuple[int, int]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; those of the image around it, too."""
        place = replace(window, line=window.line + self.line, sample=window.sample + self.sample)
        return self.image.read(place)
