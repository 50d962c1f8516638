"""Rigorous models of real products against what their producers and other tools computed."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import _rigorous_oracles as oracles

pytestmark = pytest.mark.real_data


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


def test_spot_6_has_its_frame_corners_at_one_height(metadata: Path) -> None:
    """The document has no heights: one height must suit five positions, in two coordinates each."""
    assert np.abs(oracles.spot_6_corners(metadata).difference_px).max() < 0.05
