"""Crops of real views, distorted by known maps, registered, and judged by ties."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.matching.predict import in_image
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.distortion import DistortedImage, Distortion
from amers.services.types import Array
from benchmarks._distortions import NOT_DISTORTED, Drawn, distortion_of
from benchmarks._outcome import Outcome, outcome_of
from benchmarks._real_views import VIEWS, RealView, real_view
from benchmarks._scenes import Truth
from benchmarks._trials import DISTORTED

CLEAN = "clean"
SCENES = {
    "jitter": 54,
    "bow": 36,
    "steps": 36,
    "moved": 36,
    "wrong_model": 27,
    "otherwise": 27,
    "parts": 36,
    CLEAN: 36,
}
"""Scenes of each family: 252 distorted ones, and some that are not."""
LOCATION_M = (5.0, 30.0)
OPTIONS = RegistrationOptions()
_BESIDE_PX = 30.0
"""How far crops reach beyond the points of their view."""
_GRID = 40
_KEY = 21


@dataclass(frozen=True)
class RealScene:
    """What is done to one scene.

    Attributes:
        name: family and number.
        view: of which it is a crop.
        corner: (2,) line and sample of the view where the crop begins.
        size_px: lines and samples of the crop.
        shift_px: (2,) by which its model is off.
        sigma_m: as stated.
        drawn: its distortion.
    """

    name: str
    view: str
    corner: tuple[int, int]
    size_px: int
    shift_px: tuple[float, float]
    sigma_m: float
    drawn: Drawn


@dataclass(frozen=True)
class RealPrepared:
    """A scene with its truth.

    Attributes:
        scene: what a registration gets, with the points of the view.
        view: it is a crop of.
        distortion: of the crop.
        truth: at the ties that it shows.
    """

    scene: Scene
    view: RealView
    distortion: Distortion
    truth: Truth


Result = tuple[RealScene, Outcome]


def name_of(family: str, number: int) -> str:
    """The name of a scene."""
    return f"{family}_{number:04d}"


def number_of(name: str) -> int:
    """The number of a scene."""
    return int(name.rsplit("_", 1)[1])


def view_of(name: str) -> str:
    """The view of a scene."""
    return VIEWS[number_of(name) % len(VIEWS)]


def real_scene(name: str, seed: int, view: RealView) -> RealScene:
    """What is done to the scene of a name: everything follows from it and the seed."""
    draw, key = DISTORTED.get(name.rsplit("_", 1)[0], (None, 0))
    rng = np.random.default_rng([seed, number_of(name), key, _KEY])
    first = np.clip(view.placed.min(axis=0) - _BESIDE_PX, 0.0, None)
    last = np.minimum(view.placed.max(axis=0) + _BESIDE_PX, view.scene.image.shape) - view.crop
    corner = np.rint(rng.uniform(first, np.maximum(first, last))).astype(int).tolist()
    error_m = rng.uniform(*LOCATION_M)
    towards = rng.uniform(0.0, 2.0 * np.pi)
    shift_px = error_m / scene_gsd_m(view.scene) * np.array([np.sin(towards), np.cos(towards)])
    return RealScene(
        name,
        view_of(name),
        (corner[0], corner[1]),
        view.crop,
        (float(shift_px[0]), float(shift_px[1])),
        float(error_m / rng.uniform(1.2, 2.6)),
        NOT_DISTORTED if draw is None else draw(rng, view.crop),
    )


def prepare_real(plan: RealScene, view: RealView, seed: int) -> RealPrepared:
    """A distorted crop, its model as delivered, and the truth at the ties that it shows."""
    shape, corner = (plan.size_px, plan.size_px), np.array(plan.corner, dtype=np.float64)
    rng = np.random.default_rng([seed, number_of(plan.name), _KEY])
    distortion = distortion_of(plan.drawn, shape, scene_gsd_m(view.scene), rng)
    image = DistortedImage(view.scene.image, distortion, plan.corner)
    model = view.scene.model
    if plan.drawn.tilt_deg > 0.0:
        model = _of_another_view(plan, view, rng)
    if not isinstance(model, RpcModel):
        raise TypeError(f"{plan.view}: an RPC expected, {type(model).__name__} given")
    moved = replace(model, image_offset=model.image_offset - corner + plan.shift_px)
    scene = Scene(image, moved, view.scene.acquisition, plan.sigma_m)
    return RealPrepared(scene, view, distortion, _truth(plan, view, distortion))


def register_real(
    plan: RealScene, view: RealView, seed: int
) -> tuple[RealPrepared, Outcome, Registration | None]:
    """A scene, its outcome and its registration; None when it is refused."""
    prepared = prepare_real(plan, view, seed)
    outcome, registration = outcome_of(
        prepared.scene, view.block.points, view.block, OPTIONS, prepared.truth
    )
    return prepared, outcome, registration


def run_real(name: str, seed: int, real_data: Path) -> Result:
    """What is done to the scene of a name, and its outcome."""
    view = real_view(real_data, view_of(name))
    plan = real_scene(name, seed, view)
    return plan, register_real(plan, view, seed)[1]


def _of_another_view(plan: RealScene, view: RealView, rng: np.random.Generator) -> RpcModel:
    """The model of another view, which agrees about the ground in the middle, or beside it."""
    middle = scene_centre(view.scene)
    middle[2] = float(np.median(view.ground[:, 2]))
    apart_px = view.scene.model.project(middle[None, :]) - view.another.project(middle[None, :])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    away_px = plan.drawn.away * plan.size_px * np.array([np.sin(angle), np.cos(angle)])
    return replace(view.another, image_offset=view.another.image_offset + apart_px[0] + away_px)


def _truth(plan: RealScene, view: RealView, distortion: Distortion) -> Truth:
    """What the distorted crop shows of the ties, where it shows it once and in its place."""
    corner, shape = np.array(plan.corner), distortion.shape
    line_sample = distortion.distorted(view.line_sample - corner)
    line_sample[~in_image(line_sample, shape, -2.0)] = np.nan
    shown = np.isfinite(line_sample).all(axis=1)
    shown[shown] = ~distortion.is_moved(line_sample[shown])
    ground = view.ground[shown]
    return Truth(
        line_sample=line_sample[shown],
        on_earth=ground,
        in_frame=lambda used: ground,
        judged_share=float(distortion.is_unique(_grid(shape)).mean()),
        shown_points=int(in_image(view.placed - corner, shape, 0.0).sum()),
        shortest_px=plan.drawn.shortest_px,
    )


def _grid(shape: tuple[int, int]) -> Array:
    axes = [np.linspace(0.0, size - 1.0, _GRID) for size in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
