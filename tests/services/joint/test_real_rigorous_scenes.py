"""Orbits and attitudes of real products in one block with an RPC; the vendor's RPCs say what is true."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.parameters import image_parameters
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.joint.block import JointBlock
from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.results import rigorous_scene, scene_adjustment
from amers.services.quality.stability import image_places
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.parameter_sets import SRP, ParameterSet
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.refined import refined_rpc
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Acquisition, Array, Frame
from benchmarks import _rigorous_oracles as oracles
from benchmarks._joint_scenes import (
    ImagePlan,
    JointTruth,
    SceneTruth,
    errors_px,
    joint_truth,
    measured_scene,
    places,
    tie_points,
)
from tests.services.ties import whitened_square

pytestmark = pytest.mark.real_data

OPTIONS = RegistrationOptions()
SIGMA_M = 3.5
FRAME = Frame.from_sigmas(0.5, 0.7)
PAIR = ("wv_mvp_1.xml", "wv_mvp_2.xml")


@dataclass(frozen=True)
class Product(SceneTruth):
    """A product whose true geometry is the RPC of its vendor; `delivered` is off."""

    true_model: RpcModel
    delivered: SensorModel
    free: ParameterSet | None

    def position(self, lon_lat_h: Array) -> Array:
        return self.true_model.project(lon_lat_h)

    def scene(self) -> Scene:
        blank = np.broadcast_to(np.float32(np.nan), self.shape)
        return Scene(ArrayImage(blank), self.delivered, Acquisition(self.plan.name), SIGMA_M, self.free)


@cache
def products(folder: Path) -> tuple[tuple[PushbroomModel, RpcModel], ...]:
    return tuple(
        (
            read_rigorous_model(folder / "worldview_isd" / name),
            oracles.worldview_rpc(folder, name),
        )
        for name in PAIR
    )


def product(model: PushbroomModel, rpc: RpcModel, rng: np.random.Generator) -> Product:
    """With its rigorous model, off by a draw of its set."""
    near = replace(model, height_range_m=rpc.height_range_m)
    image = rigorous_parameters("orbit", near, SRP, sigma_m=SIGMA_M)
    delivered = image.corrected(rng.normal(0.0, image.sigma))
    return Product(plan_of("orbit", model.image_shape), None, NO_ERROR, rpc, delivered, SRP)  # type: ignore[arg-type]


def with_rpc(rpc: RpcModel, shape: tuple[int, int], rng: np.random.Generator) -> Product:
    """With the RPC of its vendor, off by a shift, a drift and a skew."""
    image = image_parameters("rpc", rpc, shape, shift_px=SIGMA_M / 0.5, slope_px=1.0)
    delivered = image.corrected(rng.normal(0.0, image.sigma))
    return Product(plan_of("rpc", shape), None, NO_ERROR, rpc, delivered, None)  # type: ignore[arg-type]


NO_ERROR = ImageCorrection(np.zeros((2, 3)), np.zeros(2), np.ones(2))


def plan_of(name: str, shape: tuple[int, int]) -> ImagePlan:
    return ImagePlan(name, (0.0, 0.0), 0.0, 0.0, shape, 0.5, sigma_m=SIGMA_M)


def block_of(folder: Path, seed: int, *, control: int = 60) -> tuple[JointTruth, JointBlock]:
    """A pair of WorldView-2: the first with its orbit and attitude, the second with its RPC."""
    rng = np.random.default_rng([51, seed])
    (model, first), (other, second) = products(folder)
    images = [product(model, first, rng), with_rpc(second, other.image_shape, rng)]
    middle = np.append(first.ground_offset[:2], first.ground_offset[2])
    extent_m = np.array([-6500.0, 6500.0, -5500.0, 5500.0])
    relief_m = 0.6 * min(first.ground_scale[2], second.ground_scale[2])
    ground = places(rng, middle, extent_m, control, relief_m)
    truth = joint_truth(images, ground, rng, sigma_m=0.2, sigma_up_m=0.3, frame=FRAME)
    scenes = [measured_scene(truth, k, rng) for k in range(2)]
    ties = tie_points(images, places(rng, middle, extent_m, 900, relief_m), rng)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert not left
    return truth, block


@pytest.mark.long
def test_an_adjusted_orbit_agrees_with_the_rpc_of_the_vendor(real_data: Path) -> None:
    """What the metadata differ from it by, 0.04 to 0.4 px, no parameter of a satellite follows."""
    largest_px, squares = [], []
    for seed in range(6):
        truth, block = block_of(real_data / oracles.METADATA, seed)
        assert isinstance(block.model(0), PushbroomModel)
        for number, image in enumerate(truth.images):
            size = np.array(image.shape)
            at = image_places(image.shape) * 0.8 + 0.1 * size
            error, _ = errors_px(truth, number, block.model(number), at)
            stated = scene_adjustment(block, number, OPTIONS).covariance_at(at)
            squares.append(whitened_square(error, stated).mean())
            largest_px.append(np.hypot(*error.T).max())
    assert np.max(largest_px) < 0.6
    assert np.mean(squares) < 2.5


def test_the_rpc_of_an_adjusted_orbit_is_stated_to_miss_its_jitter(real_data: Path) -> None:
    truth, block = block_of(real_data / oracles.METADATA, 0)
    found, model = rigorous_scene(block, 0), block.model(0)
    assert found is not None
    refined = refined_rpc(model, truth.images[0].shape, found.heights_m)
    assert refined.model is not None
    assert 0.1 < refined.max_error_px < 0.4
    rng = np.random.default_rng(1)
    at = rng.uniform(0.02, 0.98, (3000, 2)) * truth.images[0].shape
    ground = model.locate(at, rng.uniform(*found.heights_m, 3000))
    off_px = np.linalg.norm(refined.model.project(ground) - at, axis=1).max()
    assert 0.7 * refined.max_error_px < off_px < 1.1 * refined.max_error_px
