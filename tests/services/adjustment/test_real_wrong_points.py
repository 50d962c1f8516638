"""Real control points of one instrument of SPOT 2, given to the image of the other one."""

import csv
from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.errors import InputError
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.sensors.parameter_sets import PARAMETER_SETS
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.types import Frame, Observations
from tests.services.adjustment.grounds import ground_of

pytestmark = pytest.mark.real_data

SIGMA_M = 350.0
point_sigma_m, mark_sigma_px = 20.0, 0.5


@pytest.mark.parametrize("name", PARAMETER_SETS)
def test_points_of_the_twin_instrument_are_refused_with_how_far_off_they_are(
    real_data: Path, name: str
) -> None:
    folder = real_data / "rigorous_metadata"
    with (folder / "spot2_gcps" / "input_GCPs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    ground = np.array([[float(row[key]) for key in ("lon", "lat", "alt")] for row in rows])
    marks = np.array([[float(row[key]) for key in ("yPix", "xPix")] for row in rows])
    number = np.arange(len(rows))
    own_m2, frame = point_sigma_m**2 * np.eye(3), Frame.from_sigmas(10.0, 10.0)
    control = ground_of(number, ground, own_m2, frame, by_hand=True)
    observations = Observations(number, np.zeros_like(number), marks, np.full(len(rows), mark_sigma_px))
    model = read_rigorous_model(folder / "spot1-5_dimap" / "SP-2.DIM")
    assert isinstance(model, PushbroomModel)
    image = rigorous_parameters("HRV1", model, PARAMETER_SETS[name], sigma_m=SIGMA_M)
    words = r"HRV1: \d+ of \d+ control points are not where the image was taken: .* 5,728 px away"
    with pytest.raises(InputError, match=words):
        adjust_block([image], observations, control=control)
