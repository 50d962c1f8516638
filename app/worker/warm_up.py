"""Load all that a registration needs: modules, compiled code, the template of the report."""

import cv2
import numpy as np
import pyogrio  # noqa: F401 - imports pandas where it is installed

import amers.app.worker.run  # noqa: F401 - imports what the processes of jobs need
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, render_chip
from amers.services.matching.multi_image import stored_chip
from amers.services.registration.on_points import register_scene
from amers.services.reports.html import page_template
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.sensors.refined import refined_rpc
from amers.services.sensors.rpc import RpcModel, check_rpc
from amers.services.types import UNKNOWN_FRAME, Acquisition, ChipArray, ControlPoints, Views

_SIZE = 520
_GSD_DEG = 1e-5
_ERROR_PX = 1.5
_PER_SIDE = 4


class _Chips:
    """Chips in memory."""

    def __init__(self, chips: ChipArray) -> None:
        self.chips = chips

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips."""
        return self.chips[row : row + count]


def warm_up() -> None:
    """Register a small random scene in memory, so that nothing is left to be loaded.

    OpenCV starts no thread meanwhile; afterwards it starts as many as it would have.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    scene, points, chips = _small_registration()
    register_scene(scene, points, chips)
    mixed = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    frame = no_correction(scene.image.shape)
    refined_rpc(
        CorrectedModel(scene.model, ImageCorrection(mixed, frame.centre, frame.half_size)),
        scene.image.shape,
    )
    page_template("registration.html")
    cv2.setNumThreads(threads)


def _small_registration() -> tuple[Scene, ControlPoints, _Chips]:
    """A random scene with a model that is wrong by a shift, and points with chips of the same image."""
    rng = np.random.default_rng(1)
    rough = rng.normal(1000.0, 200.0, (_SIZE // 4, _SIZE // 4)).astype(np.float32)
    smooth = cv2.resize(rough, (_SIZE, _SIZE), interpolation=cv2.INTER_CUBIC)
    image = ArrayImage(np.asarray(smooth, dtype=np.float32))
    model = check_rpc(_model(0.0), "the model of the warm-up")
    step_deg = 0.6 * _SIZE * _GSD_DEG * (np.arange(_PER_SIDE) / (_PER_SIDE - 1.0) - 0.5)
    lon, lat = (axis.ravel() for axis in np.meshgrid(step_deg, step_deg))
    n = len(lon)
    ground = np.column_stack([lon, lat, np.zeros(n)])
    chips = np.stack([stored_chip(render_chip(image, model, place, 1.1)) for place in ground])
    views = Views(
        np.arange(n + 1),
        np.full(n, 1.1),
        np.zeros(n, dtype=np.int64),
        np.zeros(n),
        np.zeros(n),
        np.ones(n),
        (Acquisition("warm-up", incidence_deg=0.0, azimuth_deg=0.0),),
    )
    points = ControlPoints(
        np.arange(n),
        ground,
        np.tile(0.01 * np.eye(3), (n, 1, 1)),
        np.zeros(n, dtype=np.int64),
        (UNKNOWN_FRAME,),
        np.ones(n),
        np.ones(n),
        views,
        np.zeros(n, dtype=np.int64),
        np.arange(n),
        ("chips",),
    )
    acquisition = Acquisition("warm-up", incidence_deg=0.0, azimuth_deg=0.0)
    return Scene(image, _model(_ERROR_PX), acquisition, 2.0), points, _Chips(chips)


def _model(error_px: float) -> RpcModel:
    """A sensor that looks straight down on longitude 0, latitude 0, with an error of its position."""
    one, lon, lat = (np.eye(20)[k] for k in range(3))
    middle = (_SIZE - 1.0) / 2.0
    half_deg = _SIZE / 2.0 * _GSD_DEG
    return RpcModel(
        -lat,
        one,
        lon,
        one,
        np.full(2, middle + error_px),
        np.full(2, _SIZE / 2.0),
        np.zeros(3),
        np.array([half_deg, half_deg, 100.0]),
    )
