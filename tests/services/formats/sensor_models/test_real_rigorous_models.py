"""Rigorous models of real products against what their producers and other tools computed."""

from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.sensors.parameter_sets import TOUTIN
from benchmarks import _rigorous_oracles as oracles

pytestmark = [pytest.mark.real_data, pytest.mark.thorough]


@pytest.fixture(scope="module")
def metadata(real_data: Path) -> Path:
    """The folder of the metadata of real products."""
    return real_data / oracles.METADATA


def test_pleiades_agrees_with_the_location_grid_of_cnes(metadata: Path) -> None:
    a_thousandth_of_a_pixel = 0.001
    assert np.abs(oracles.pleiades_grid(metadata).difference_px).max() < a_thousandth_of_a_pixel


@pytest.mark.parametrize("name", oracles.PLEIADES)
def test_pleiades_agrees_with_the_rational_functions_of_its_document(metadata: Path, name: str) -> None:
    assert np.abs(oracles.pleiades_rpc(metadata, name).difference_px).max() < 0.05


@pytest.mark.parametrize("name", oracles.WORLDVIEW)
def test_worldview_agrees_with_the_rpc_of_the_vendor(metadata: Path, name: str) -> None:
    difference_px = oracles.worldview(metadata, name).difference_px
    assert np.abs(difference_px.mean(axis=0)).max() < 0.1
    assert difference_px.std(axis=0).max() < 0.4


@pytest.mark.parametrize("name", oracles.SPOT)
@pytest.mark.long
def test_spot_agrees_with_its_frame_corners_up_to_the_attitude_they_leave_out(
    metadata: Path, name: str
) -> None:
    limit_px = 0.02 if name == "SPOT5.DIM" else 2.5
    assert np.abs(oracles.spot_corners(metadata, name).difference_px).max() < limit_px
    if name != "SPOT5.DIM":
        without_attitude = oracles.spot_corners_without_attitude(metadata, name)
        assert np.abs(without_attitude.difference_px).max() < 0.3


def test_spot_2_agrees_with_the_rpc_that_another_tool_fitted_to_the_same_metadata(
    metadata: Path,
) -> None:
    difference_px = oracles.spot_2_rpc(metadata).difference_px
    assert np.abs(difference_px.mean(axis=0)).max() < 0.3
    assert difference_px.std(axis=0).max() < 0.4


@pytest.mark.parametrize("pattern", ["**/PHRDIMAP*.XML", "**/SP*.DIM", "**/SPOT6.XML", "**/WV*.XML"])
@pytest.mark.long
def test_free_parameters_of_real_models_move_them_as_predicted(metadata: Path, pattern: str) -> None:
    rng = np.random.default_rng(3)
    files = sorted(metadata.glob(pattern))
    assert files
    for file in files:
        image = rigorous_parameters(file.name, read_rigorous_model(file), TOUTIN, sigma_m=100.0)
        places = rng.uniform(0.02, 0.98, (40, 2)) * image.shape
        ground = image.model.locate(places, rng.uniform(0.0, 1000.0, 40))
        for k in range(len(image.sigma)):
            step = np.eye(len(image.sigma))[k]
            after, before = (image.corrected(sign * step).project(ground) for sign in (0.5, -0.5))
            predicted = image.computed(0.0 * step, ground).by_parameters[:, :, k]
            np.testing.assert_allclose(after - before, predicted, atol=0.01)
        middle = (np.array([image.shape]) - 1.0) / 2.0
        computed = image.computed(np.zeros(len(image.sigma)), image.model.locate(middle, [500.0]))
        moved_m = np.linalg.solve(computed.by_ground[0, :, :2], computed.by_parameters[0] * image.sigma)
        np.testing.assert_allclose(np.linalg.norm(moved_m, axis=1), 100.0, rtol=0.1)


def test_spot_6_has_its_frame_corners_at_one_height(metadata: Path) -> None:
    """The document has no heights: one height must suit five positions, in two coordinates each."""
    assert np.abs(oracles.spot_6_corners(metadata).difference_px).max() < 0.05
