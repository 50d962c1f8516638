"""A scene registered on the points of an adjusted block: do its 90 % regions hold the truth?"""

import numpy as np
from scipy.stats import chi2

from amers.services.adjustment.bundle import BlockAdjustment
from amers.services.geodesy import move_metres
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.quality.stability import image_places
from amers.services.sensors.correction import ImageCorrection
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Array

MEASURE_SIGMA_PX = 0.1
_MOST = 300
"""Points that the scene is registered on."""


def scene_held(
    block: BlockAdjustment,
    truth: Array,
    frame_error_m: Array,
    scene: ViewGeometry,
    correction: ImageCorrection,
) -> tuple[float, float]:
    """Shares of the corners and the centre of a scene whose regions hold the truth.

    The scene sees the points where they truly are, with a noise of 0.1 px.

    Args:
        block: adjusted.
        truth: (p, 3) of its points.
        frame_error_m: (3,) east, north, up, that its points share.
        scene: the geometry of the image, which took no part in the block.
        correction: the true one.

    Returns:
        Share relative to the points, share on the Earth.
    """
    shape = scene.plan.shape
    rng = np.random.default_rng(len(truth))
    position = correction.apply(scene.rpc.project(truth))
    seen = ((position >= 0.0) & (position <= np.array(shape) - 1.0)).all(axis=1)
    seen = seen[: len(block.lon_lat_h)] & np.isfinite(block.lon_lat_h[:, 0])
    rows = rng.permutation(np.flatnonzero(seen))[:_MOST]
    to_px = scene.rpc.project_derivative(truth[rows]).mean(axis=0)
    adjustment = adjust_scene(
        scene.rpc,
        shape,
        ControlObservations(
            lon_lat_h=block.lon_lat_h[rows],
            line_sample=position[rows] + rng.normal(0.0, MEASURE_SIGMA_PX, (len(rows), 2)),
            sigma_px=np.full(len(rows), MEASURE_SIGMA_PX),
            covariance_m2=block.point_covariance_m2[rows],
            deformation_px2=to_px @ block.frames[0].shared_m2 @ to_px.T,
        ),
    )
    places = image_places(shape)
    height_m = np.full(len(places), np.median(truth[rows, 2]))
    ground = scene.rpc.locate(places, height_m)
    in_block = move_metres(ground, np.tile(frame_error_m, (len(ground), 1)))
    true_px = correction.apply(scene.rpc.project(ground))
    covariance = adjustment.covariance_at(true_px)
    by_ground = scene.rpc.project_derivative(ground)
    frame = by_ground @ block.frames[0].covariance_m2 @ by_ground.transpose(0, 2, 1)
    relative_px = adjustment.correction.apply(scene.rpc.project(in_block)) - true_px
    on_earth_px = adjustment.correction.apply(scene.rpc.project(ground)) - true_px
    return _share(relative_px, covariance), _share(on_earth_px, covariance + frame)


def _share(error_px: Array, covariance: Array) -> float:
    square = (error_px * np.linalg.solve(covariance, error_px[:, :, None])[:, :, 0]).sum(axis=1)
    return float((square <= chi2.ppf(0.9, 2)).mean())
