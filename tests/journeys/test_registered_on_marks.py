"""A real view registered on a few marks by command, checked on independent ties of three views."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.geodesy import move_metres
from amers.services.sensors.correction import ImageCorrection, fold_into_rpc, no_correction
from amers.services.types import Array
from tests.command_line import Done, amers_here
from tests.journeys.ties import KnownGround

pytestmark = [pytest.mark.real_data, pytest.mark.long]

OFF_PX = np.array([24.0, -32.0])
BLUNDER_PX = np.array([36.0, 48.0])
SURVEY = (0.1, 0.3)
A_MAP = (3.0, 0.5)
"""Sigma of the ground, metres, and of the picks, pixels."""
GSD_M = 0.5
DRAWS = 5
three_tenths_of_a_pixel = 0.3
HEAD = "id,lon,lat,height_m,line,sample,sigma_horizontal_m,sigma_up_m,sigma_px"


@pytest.fixture(scope="module")
def ties(real_data: Path) -> KnownGround:
    return KnownGround.of_triplet(real_data)


@pytest.fixture
def image(real_data: Path, tmp_path: Path, ties: KnownGround) -> Path:
    """The view with a model that is 40 px off."""
    path = tmp_path / "img_02.tif"
    shutil.copy(real_data / "phr_calanques_triplet" / path.name, path)
    frame = no_correction(ties.shape)
    off = ImageCorrection(np.column_stack([OFF_PX, np.zeros((2, 2))]), frame.centre, frame.half_size)
    model = fold_into_rpc(ties.model, off)
    path.with_name("img_02_RPC.TXT").write_text(format_rpc_text(model))
    return path


def marks(
    image: Path,
    ties: KnownGround,
    count: int,
    sigmas: tuple[float, float],
    *,
    draw: int = 0,
    wrong: bool = False,
) -> Path:
    """A file of marks on ties, with the errors that it states."""
    sigma_m, sigma_px = sigmas
    rng = np.random.default_rng(draw)
    rows = np.roll(chosen(ties), -20 * draw)[:count]
    ground = move_metres(ties.ground[rows], rng.normal(0.0, sigma_m, (count, 3)))
    picked = ties.shown[rows] + rng.normal(0.0, sigma_px, (count, 2))
    if wrong:
        picked[-1] += BLUNDER_PX * np.sign(np.array(ties.shape) / 2.0 - picked[-1])
    lines = [
        f"GCP{k},{lon!r},{lat!r},{h!r},{line!r},{sample!r},{sigma_m},{sigma_m},{sigma_px}"
        for k, (lon, lat, h, line, sample) in enumerate(np.hstack([ground, picked]).tolist())
    ]
    path = image.with_name("marks.csv")
    path.write_text("\n".join(["# pixel-origin=centre heights=ellipsoid", HEAD, *lines]) + "\n")
    return path


def chosen(ties: KnownGround) -> Array:
    """Rows of ties that become marks, at random places."""
    return np.random.default_rng(7).permutation(len(ties.ground))


def register(image: Path, file: Path) -> Done:
    command = ["scene", "register", image, "--control", file, "-o", image.parent / "out"]
    return amers_here(command, dict(os.environ))


def off_px(image: Path, ties: KnownGround) -> Array:
    """Mean distance (2,) of the ties that no mark is on from the refined model."""
    model = read_rpc(image, image.parent / "out" / "img_02_RPC.TXT").model
    rows = chosen(ties)[20 * DRAWS :]
    return np.asarray((ties.shown[rows] - model.project(ties.ground[rows])).mean(axis=0))


def report(image: Path) -> dict:
    return json.loads((image.parent / "out" / "report.json").read_text())


@pytest.mark.parametrize("wrong", [False, True])
def test_eight_marks_bring_back_a_model_40_px_off(image, ties, wrong):
    assert len(ties.ground) > 500
    off = []
    for draw in range(DRAWS):
        ended = register(image, marks(image, ties, 8, SURVEY, draw=draw, wrong=wrong))
        assert ended.returncode == 0, ended.stderr
        off.append(np.hypot(*off_px(image, ties)))
        every = report(image)["marks"]["marks"]
        assert [mark["name"] for mark in every if mark["status"] == "rejected"] == ["GCP7"] * wrong
        assert ("Mark GCP7 is not used" in ended.stdout) == wrong
    print(f"off by {np.round(off, 2)} px, blunder: {wrong}")
    assert np.sqrt(np.mean(np.square(off))) < three_tenths_of_a_pixel


@pytest.mark.parametrize("sigmas", [SURVEY, A_MAP])
@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_the_stated_accuracy_holds_the_true_error(image, ties, count, sigmas):
    ended = register(image, marks(image, ties, count, sigmas))
    assert ended.returncode == 0, ended.stderr
    off, ce90_m = off_px(image, ties), report(image)["relative_to_control_points"]["ce90_m"]
    print(f"{count} marks of {sigmas[0]} m: off by {GSD_M * np.hypot(*off):.2f} m, CE90 {ce90_m:.2f} m")
    assert GSD_M * np.hypot(*off) < 1.3 * ce90_m
