"""Search of a scene displaced by kilometres: small chips in a map of the scene, and one shift."""

import math
from collections import Counter
from dataclasses import dataclass, replace

import cv2
import numpy as np

from amers.services.conventions import CHIP_CENTRE, CHIP_SIZE
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import east_north_up, lon_lat_h_from_east_north_up
from amers.services.imagery.gaps import filled
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.imagery.source import low_pass, sample_image
from amers.services.matching.consensus import Consensus
from amers.services.matching.control_points import chip_pixels
from amers.services.matching.multi_image import nearly_whole
from amers.services.matching.radiometry import gradient_image
from amers.services.matching.view_selection import select_views
from amers.services.registration.another_view import another_view
from amers.services.registration.context import (
    Candidate,
    NotFound,
    Prediction,
    RegistrationContext,
    SearchStage,
)
from amers.services.registration.point_selection import points_expected
from amers.services.registration.search import (
    FIRST_TOLERANCE_PX,
    check_consensus,
    first_consensus,
    largest_error_m,
)
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.types import (
    Array,
    BoolArray,
    ChipSource,
    ControlPoints,
    FloatImage,
    IntArray,
    point_chips,
)

MAX_MAP_SIDE = 2501
"""Largest side of the map of a scene, pixels: 20 km at 8 m. Of a larger scene the middle is searched."""
MAX_CORRELATED_PX = 3_333_333
"""Pixels in which chips are correlated, all together, for each point that the scene should show, beyond
which chips and map are reduced."""
_TILE_PX = 256
_NODE_PX = 16
"""Pixels of the map between nodes that are projected through the model."""
_MAX_MISSING = 0.1
"""Largest share of the map under a chip that may be without data."""
_EVEN = 1e-4
"""Standard deviation of even ground, by that of the map: below it, correlations are rounding errors."""


@dataclass(frozen=True)
class _Map:
    """The scene, or the middle of a large one, north up on a horizontal plane.

    Attributes:
        pixels: (size, size) float32; NaN where the scene has no data.
        centre: (3,) ground position of the central pixel.
        level_m: ground sampling.
        model: through which it was rendered.
    """

    pixels: FloatImage
    centre: Array
    level_m: float
    model: SensorModel

    def row_col(self, line_sample: Array) -> Array:
        """Positions (n, 2) in the map of positions in the scene (n, 2), pixels."""
        ground = self.model.locate(line_sample, np.full(len(line_sample), self.centre[2]))
        east, north = east_north_up(ground, self.centre)[:, :2].T / self.level_m
        return np.column_stack([-north, east]) + self.pixels.shape[0] // 2

    def line_sample(self, row_col: Array) -> Array:
        """Positions (n, 2) in the scene of positions in the map (n, 2)."""
        down, right = (row_col - self.pixels.shape[0] // 2).T * self.level_m
        enu = np.column_stack([right, -down, np.zeros(len(row_col))])
        return self.model.project(lon_lat_h_from_east_north_up(enu, self.centre))


@dataclass(frozen=True)
class _Plan:
    """Chips and points of the search.

    Attributes:
        gsd_m: ground sampling of the chips, as they are stored.
        reduction: factor by which the chips are reduced.
        error_m: largest error that is expected.
        size: side of the map, pixels; odd.
        whole: side of the map that would hold all of the scene, pixels.
        cut_px: (2,) lines and samples at each border of the scene that lie beyond the map.
        rows: the points to try.
    """

    gsd_m: float
    reduction: int
    error_m: float
    size: int
    whole: int
    cut_px: Array
    rows: IntArray

    @property
    def level_m(self) -> float:
        """Ground sampling of the reduced chips and of the map."""
        return self.gsd_m * self.reduction

    @property
    def radius_px(self) -> int:
        """Search radius, pixels of the map."""
        return int(np.ceil(self.error_m / self.level_m)) + 2

    @property
    def middle_m(self) -> float:
        """Side of the middle part of the scene that the map shows, metres; NaN for the whole scene."""
        return self.size * self.level_m if self.size < self.whole else math.nan


def search_far(
    context: RegistrationContext,
    points: ControlPoints,
    chips: ChipSource,
    prediction: Prediction,
    gsd_m: float,
) -> Prediction:
    """A prediction of all points by a shift of the image that many of their chips agree on.

    The scene is rendered once into a map of the ground sampling of the chips. The mean of the views of
    each point is correlated with all of the map that the error may reach. A small scene shows few of
    the points around it: the consensus counts those that it could show. Where grey values do not agree,
    their gradients are tried.

    Args:
        context: of the registration.
        points: all that the scene may show.
        chips: of these points.
        prediction: of the points by the delivered model.
        gsd_m: ground sampling of the chips to use.

    Raises:
        NotEnoughPoints: the scene is expected to show no point whole.
        NoConsensus: the points found agree no better than by chance.
    """
    scene, options = context.scene, context.options.coarse
    plan = _plan(context, points, prediction, gsd_m)
    if not len(plan.rows):
        raise NotEnoughPoints(0, 2, "the scene is expected to show none of them whole")
    tried = points.take(plan.rows)
    context.progress(0.0, f"searching {len(tried)} points within {plan.error_m / 1000.0:.1f} km")
    predicted = prediction.model.project(tried.lon_lat_h)
    scene_map = _render(scene, prediction.model, plan, tried)
    templates = _templates(context, tried, chips, plan)
    measured, reason, consensus = _searched(context, scene_map, templates, predicted, plan)
    stage = _summary(scene, plan, consensus, reason)
    context.stages.append(stage)
    check_consensus(
        stage,
        consensus,
        reason,
        scene,
        options.max_false_alarms / 2.0,
        of_another=lambda: another_view(scene, stage, tried.lon_lat_h, predicted, measured),
    )
    correction = no_correction(scene.image.shape)
    correction.parameters[:, 0] = consensus.displacement
    uncertainty_m = np.hypot(
        np.sqrt(points.covariance_m2[:, [0, 1], [0, 1]].max(axis=1)),
        FIRST_TOLERANCE_PX * plan.level_m / 2.0,
    )
    return Prediction(CorrectedModel(scene.model, correction), uncertainty_m)


def _searched(
    context: RegistrationContext,
    scene_map: _Map,
    templates: list[FloatImage],
    predicted: Array,
    plan: _Plan,
) -> tuple[Array, np.ndarray, Consensus]:
    """Positions (n, 2) of chips, why there is none (n,), and on what they agree."""
    for is_last in (False, True):
        if is_last:
            scene_map = replace(scene_map, pixels=gradient_image(scene_map.pixels))
            templates = [gradient_image(chip) for chip in templates]
        measured, reason = _find(context, scene_map, templates, predicted, plan)
        consensus = first_consensus(
            context.scene,
            predicted,
            measured,
            level_m=plan.level_m,
            radius_m=plan.radius_px * plan.level_m,
            side_m=CHIP_SIZE * plan.gsd_m,
            cut_px=plan.cut_px,
        )
        # Two tries are two chances.
        if 2.0 * consensus.false_alarms <= context.options.coarse.max_false_alarms:
            break
    return measured, reason, consensus


def _plan(
    context: RegistrationContext, points: ControlPoints, prediction: Prediction, gsd_m: float
) -> _Plan:
    """The points to try, and chips reduced as far as the work and the map ask for."""
    scene, options = context.scene, context.options.coarse
    extent_m = _half_extent_m(scene)
    error_m = largest_error_m(prediction.uncertainty_m)
    for reduction in range(1, options.max_reduction + 1):
        level_m = gsd_m * reduction
        whole = 2 * int(np.ceil(extent_m / level_m)) + 1
        size = min(whole, MAX_MAP_SIDE)
        cut = max(0.0, 1.0 - size / whole) / 2.0
        cut_px = cut * np.array(scene.image.shape)
        rows = points_expected(scene, points, prediction, gsd_m, count=options.points, cut_px=cut_px)
        side = min(2.0 * error_m / level_m + CHIP_SIZE / reduction, size)
        if size == whole and len(rows) * side**2 <= MAX_CORRELATED_PX * options.points:
            break
    return _Plan(gsd_m, reduction, error_m, size, whole, cut_px, rows)


def _half_extent_m(scene: Scene) -> float:
    """Half side of the smallest square, north up, that holds a scene."""
    last = np.array(scene.image.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]) * last
    centre = scene_centre(scene)
    ground = scene.model.locate(corners, np.full(4, centre[2]))
    return float(np.abs(east_north_up(ground, centre)[:, :2]).max())


def _render(scene: Scene, model: SensorModel, plan: _Plan, points: ControlPoints) -> _Map:
    """The map of a scene at the middle height of points, tile by tile."""
    centre = scene.model.locate(
        (np.array([scene.image.shape]) - 1.0) / 2.0, np.array([np.median(points.lon_lat_h[:, 2])])
    )[0]
    pixels = np.full((plan.size, plan.size), np.nan, dtype=np.float32)
    scene_map = _Map(pixels, centre, plan.level_m, model)
    ratio = plan.level_m / scene_gsd_m(scene)
    node = np.arange(0, _TILE_PX + 1, _NODE_PX)
    weight = np.maximum(0.0, 1.0 - np.abs(np.arange(_TILE_PX)[:, None] - node) / _NODE_PX)
    for row, col in np.ndindex(-(-plan.size // _TILE_PX), -(-plan.size // _TILE_PX)):
        first = np.array([row, col]) * _TILE_PX
        nodes = first + np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2)
        seen = scene_map.line_sample(nodes.astype(np.float64)).reshape(len(node), len(node), 2)
        if not np.isfinite(seen).all():
            continue
        positions = np.stack([weight @ seen[..., k] @ weight.T for k in range(2)], axis=-1)
        tile = pixels[first[0] : first[0] + _TILE_PX, first[1] : first[1] + _TILE_PX]
        tile[:] = sample_image(scene.image, positions, ratio)[: tile.shape[0], : tile.shape[1]]
    pixels[~np.isfinite(pixels)] = np.nan
    return scene_map


def _templates(
    context: RegistrationContext, points: ControlPoints, chips: ChipSource, plan: _Plan
) -> list[FloatImage]:
    """The mean of the standardised views of each point, reduced; empty where no view is nearly whole."""
    options, scene = context.options.matching, context.scene
    selected = select_views(
        points, plan.gsd_m, scene.acquisition, options.max_views, options.view_distance
    )
    blur = max(scene_gsd_m(scene) / plan.gsd_m, float(plan.reduction))
    first = CHIP_CENTRE % plan.reduction
    templates = []
    for row in range(len(points)):
        views = selected.row[selected.start[row] : selected.start[row + 1]] - points.views.start[row]
        stored = [chip_pixels(chip) for chip in point_chips(points, chips, row)[views]]
        smooth = [low_pass(filled(chip), blur) for chip in stored if nearly_whole(chip)]
        if not smooth:
            templates.append(np.zeros((0, 0), dtype=np.float32))
            continue
        small = np.stack(smooth)[:, first :: plan.reduction, first :: plan.reduction]
        spread = small.std(axis=(1, 2), keepdims=True)
        small = ((small - small.mean(axis=(1, 2), keepdims=True)) / spread)[spread[:, 0, 0] > 0.0]
        templates.append(small.mean(axis=0) if len(small) else np.zeros((0, 0), dtype=np.float32))
    return templates


def _find(
    context: RegistrationContext,
    scene_map: _Map,
    templates: list[FloatImage],
    predicted: Array,
    plan: _Plan,
) -> tuple[Array, np.ndarray]:
    """Positions (n, 2) in the scene where chips correlate best, and why there is none (n,)."""
    side, size = max((len(chip) for chip in templates), default=0), len(scene_map.pixels)
    found = np.full((len(templates), 2), np.nan)
    reason = np.full(len(templates), "nodata", dtype="<U16")
    missing = ~np.isfinite(scene_map.pixels)
    if not 0 < side <= size or missing.all():
        return found, reason
    pixels = scene_map.pixels - np.float32(np.nanmean(scene_map.pixels))
    pixels[missing] = 0.0
    contrast, unusable = _contrast(pixels, side), _gaps(missing, side) > _MAX_MISSING * side**2
    centres = scene_map.row_col(predicted)
    for i, chip in enumerate(templates):
        if i % 64 == 0:
            context.progress(i / len(templates), f"searching {len(templates)} points in the whole scene")
        if len(chip) == 0 or not np.isfinite(centres[i]).all():
            continue
        wanted = np.round(centres[i]).astype(int) - side // 2
        top, left = (int(v) for v in np.maximum(wanted - plan.radius_px, 0))
        bottom, right = (int(v) for v in np.minimum(wanted + plan.radius_px, size - side) + 1)
        if bottom <= top or right <= left:
            continue
        places = slice(top, bottom), slice(left, right)
        if unusable[places].all():
            continue
        patch = pixels[top : bottom + side - 1, left : right + side - 1]
        offset, score = _best(patch, chip, contrast[places], unusable[places])
        best = offset + (top, left)
        if not context.options.coarse.min_score <= score <= 1.001:
            reason[i] = "low_score"
        elif (np.abs(best - wanted) >= plan.radius_px).any():
            reason[i] = "border_peak"
        else:
            reason[i], found[i] = "", best + side // 2
    return scene_map.line_sample(found), reason


def _best(
    patch: FloatImage, chip: FloatImage, contrast: FloatImage, unusable: BoolArray
) -> tuple[IntArray, float]:
    """Row and column (2,) where a chip correlates best with a patch, and how well."""
    scores = cv2.matchTemplate(patch, _standardised(chip), cv2.TM_CCORR) / contrast
    scores[unusable] = -1.0
    return np.array(np.unravel_index(int(scores.argmax()), scores.shape)), float(scores.max())


def _contrast(pixels: FloatImage, side: int) -> FloatImage:
    """Root of the sum of squared deviations from their mean of the pixels under each chip of a side.

    With `_standardised` chips it makes covariances normalised correlations, for all chips at once:
    `cv2.TM_CCOEFF_NORMED` spends most of its time to compute it for each. Infinite on even ground.
    """
    size = len(pixels) - side + 1
    chip, first = (side, side), (0, 0)
    total = cv2.boxFilter(pixels, cv2.CV_64F, chip, anchor=first, normalize=False)[:size, :size]
    squares = cv2.sqrBoxFilter(pixels, cv2.CV_64F, chip, anchor=first, normalize=False)[:size, :size]
    contrast2 = squares - total**2 / side**2
    even = contrast2 <= (_EVEN * side) ** 2 * np.mean(pixels**2, dtype=np.float64)
    return np.asarray(np.sqrt(np.where(even, np.inf, contrast2)), dtype=np.float32)


def _standardised(chip: FloatImage) -> FloatImage:
    """A chip less its mean, of which the squares add up to 1; all zeros for an even chip."""
    around_mean = chip - np.float32(chip.mean(dtype=np.float64))
    norm = float(np.linalg.norm(around_mean))
    return np.asarray(around_mean / np.float32(norm or 1.0))


def _gaps(missing: BoolArray, side: int) -> IntArray:
    """Number of missing pixels under each chip of a side."""
    count = cv2.integral(missing.astype(np.uint8))
    below = count[side:] - count[:-side]
    return np.asarray(below[:, side:] - below[:, :-side])


def _summary(scene: Scene, plan: _Plan, consensus: Consensus, reason: np.ndarray) -> SearchStage:
    """The summary of the search."""
    derivative = scene.model.project_derivative(scene_centre(scene)[None, :])[0, :, :2]
    moved_m = np.linalg.solve(derivative, consensus.displacement)
    count = int(consensus.inliers.sum())
    east_m, north_m = moved_m.tolist()
    group = (Candidate(count, east_m, north_m, consensus.false_alarms),) if count >= 2 else ()
    counted = Counter(r for r in reason.tolist() if r).most_common()
    return SearchStage(
        name="far",
        chip_gsd_m=plan.level_m,
        search_radius_m=plan.radius_px * plan.level_m,
        needed_radius_m=plan.error_m,
        tried=len(reason),
        matched=int((reason == "").sum()),
        at_border=int((reason == "border_peak").sum()),
        inliers=count,
        displacement_rms_m=math.hypot(east_m, north_m),
        not_found=tuple(NotFound(*of_reason) for of_reason in counted),
        candidates=group,
        middle_m=plan.middle_m,
    )
