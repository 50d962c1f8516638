"""Deliverables of a registration: correction, RPC where one fits, map grid and layers for a GIS."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from amers.services.errors import FormatError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.correction_json import (
    format_correction,
    parse_correction,
    parse_correction_accuracy,
)
from amers.services.formats.sensor_models.refined_model import (
    AdjustedRigorous,
    Stated,
    write_refined,
)
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.refined import REFIT_LIMIT_PX, RefinedRpc, refined_rpc
from amers.services.simulation.orbit import pushbroom_over
from tests.services.formats.statements.scene_files import CROP, write_image

A_MICROMETRE = 1e-6
CORRECTION = ImageCorrection(
    np.array([[12.0, 1.5, -0.25], [-7.0, 0.125, 0.5]]),
    np.array([499.5, 599.5]),
    np.array([500.0, 600.0]),
)


def written(correction: ImageCorrection = CORRECTION) -> str:
    covariance = np.diag([np.nan, 1, 2, 3, 4, 5])
    stated = CorrectionAccuracy(correction, covariance, np.zeros(2))
    return format_correction(stated, "affine", applies_to="tags", carried="none")


def test_a_correction_survives_a_round_trip() -> None:
    again = parse_correction(written())
    for name in ("parameters", "centre", "half_size"):
        np.testing.assert_array_equal(getattr(again, name), getattr(CORRECTION, name))
    assert json.loads(written())["covariance_px2"][0][0] is None


def on_grid() -> ImageCorrection:
    line, sample = np.array([0.0, 400.0, 999.0]), np.array([0.0, 1199.0])
    displacement_px = np.array([[[0.0, 1.0]] * 2, [[2.0, -1.0]] * 2, [[0.5, 0.0], [0.25, 0.125]]])
    grid = DisplacementGrid(line, sample, displacement_px, np.full((3, 2, 2), 0.04))
    return replace(CORRECTION, displacement=grid)


def test_a_correction_on_a_grid_survives_a_round_trip_in_its_own_format() -> None:
    document = json.loads(written(on_grid()))
    assert document["format"] == "amers-image-correction/3"
    again, before = parse_correction(json.dumps(document)).displacement, on_grid().displacement
    assert again is not None
    assert before is not None
    for name in ("line", "sample", "displacement_px", "variance_px2"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))
    assert json.loads(written())["format"] == "amers-image-correction/1"


def test_the_variance_of_a_position_at_a_node_is_one_whatever_the_displacement_adds() -> None:
    """Parameters and displacement are uncertain by more than their sum: what it adds is negative."""
    correction = on_grid()
    grid = correction.displacement
    assert grid is not None
    less = replace(correction, displacement=replace(grid, variance_px2=np.full((3, 2, 2), -0.9)))
    covariance, local_px = np.eye(6), np.array([0.1, 0.2])
    document = json.loads(
        format_correction(
            CorrectionAccuracy(less, covariance, local_px), "affine", applies_to="tags", carried="none"
        )
    )["displacement"]
    variance = np.array(document["position_variance_px2"])
    assert variance.shape == (3, 2, 2)
    assert (variance >= 0.0).all()
    node = less.apply(np.array([[grid.line[1], grid.sample[0]]]))
    expected = np.diagonal(less.covariance_at(node, covariance, local_px)[0])
    np.testing.assert_allclose(variance[1, 0], expected, atol=1e-6)


def test_the_area_that_points_hold_is_beside_the_correction() -> None:
    ring = np.array([[0.0, 0.0], [0.0, 99.96], [50.0, 0.0], [0.0, 0.0]])
    stated = CorrectionAccuracy(CORRECTION, np.eye(6), np.zeros(2))
    text = format_correction(stated, "affine", applies_to="", carried="", held=[ring])
    assert json.loads(text)["held_outline_px"] == [[[0.0, 0.0], [0.0, 100.0], [50.0, 0.0], [0.0, 0.0]]]
    assert "held_outline_px" not in json.loads(written())
    assert np.array_equal(parse_correction(text).parameters, CORRECTION.parameters)


def by_line() -> dict[str, Any]:
    """A document of a correction by line, as it was written before grids were."""
    document: dict[str, Any] = json.loads(written())
    profile = {
        "line": [0.0, 400.0, 999.0],
        "displacement_px": [[0.0, 1.0], [2.0, -1.0], [0.5, 0.0]],
        "variance_px2": [[0.04, 0.09]] * 3,
        "with_parameters_px2": [[[-0.01, 0.002, 0.003], [-0.02, 0.004, -0.001]]] * 3,
    }
    return document | {"format": "amers-image-correction/2", "profile": profile}


def test_a_correction_by_line_of_an_older_version_is_read() -> None:
    correction = parse_correction(json.dumps(by_line()))
    place = np.array([[400.0, 300.0], [700.0, 900.0]])
    np.testing.assert_allclose(
        correction.apply(place) - CORRECTION.apply(place),
        [[2.0, -1.0], [2.0 - 1.5 * 300 / 599, -299 / 599]],
    )
    t = np.array([1.0, -99.5 / 500.0, -299.5 / 600.0])
    expected = [0.04 + 2.0 * t @ [-0.01, 0.002, 0.003], 0.09 + 2.0 * t @ [-0.02, 0.004, -0.001]]
    assert correction.displacement is not None
    np.testing.assert_allclose(correction.displacement.variance_at(place[:1])[0], expected)


@pytest.mark.parametrize(
    ("made", "part", "name", "value", "says"),
    [
        (by_line, "profile", "line", [0.0, 400.0, 400.0], "line: expected two ascending numbers"),
        (by_line, "profile", "line", None, "profile: expected an object with the lists"),
        (by_line, "profile", "displacement_px", [[0.0, 1.0]], "expected 3 x 2 finite numbers"),
        (
            by_line,
            "profile",
            "variance_px2",
            [[0.0, -1.0]] * 3,
            "expected numbers that are not negative",
        ),
        (None, "displacement", "line", [0.0, 400.0, 400.0], "line: expected two ascending numbers"),
        (None, "displacement", "sample", [7.0], "displacement: sample: expected two ascending numbers"),
        (None, "displacement", "line", None, "displacement: line: expected 2 finite numbers"),
        (None, "displacement", "variance_px2", [[0.0]], "variance_px2: expected 3 x 2 x 2 finite"),
    ],
)
def test_displacements_that_make_no_sense_are_refused(
    made: Callable[[], dict[str, Any]] | None, part: str, name: str, value: object, says: str
) -> None:
    document = made() if made else json.loads(written(on_grid()))
    document[part][name] = value
    with pytest.raises(FormatError, match=says):
        parse_correction(json.dumps(document))


def test_a_correction_without_a_frame_has_an_unknown_one() -> None:
    document = json.loads(written())
    del document["frame_covariance_m2"], document["apart_px"]
    stated = parse_correction_accuracy(json.dumps(document))
    assert np.isnan(stated.frame.covariance_m2).all()
    assert stated.apart_px == 0.0
    assert np.isnan(stated.relative_px2(np.zeros((1, 2)))).any()


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("covariance_px2", [[1.0]], "covariance_px2: expected 6 x 6 numbers or nulls"),
        ("frame_covariance_m2", [[1, 0, 0], [0, -1, 0], [0, 0, 1]], "expected a covariance matrix"),
        ("frame_covariance_m2", "none", "frame_covariance_m2: expected 3 x 3 numbers or nulls"),
        ("apart_px", -1.0, "apart_px: expected a number that is not negative"),
        ("local_sigma_px", [1.0, None], "local_sigma_px: expected 2 finite numbers"),
    ],
)
def test_errors_of_a_correction_that_make_no_sense_are_refused(
    name: str, value: object, says: str
) -> None:
    document = json.loads(written()) | {name: value}
    with pytest.raises(FormatError, match=says):
        parse_correction_accuracy(json.dumps(document))


def test_the_formula_in_the_document_is_the_one_applied() -> None:
    document = json.loads(written())
    place = np.array([100.0, 900.0])
    t = (place - np.array(document["centre_px"])) / np.array(document["half_size_px"])
    moved = place + np.array(document["parameters_px"]) @ [1.0, *t]
    np.testing.assert_allclose(CORRECTION.apply(place[None])[0], moved)


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("amers-image-correction/1", "other/1", "expected a document of the format amers-image"),
        ("499.5", '"a"', "centre_px: expected 2 finite numbers"),
        ("1.5", "NaN", "parameters_px: expected 2 x 3 finite numbers"),
        ("500.0", "-500.0", "half_size_px: expected positive numbers"),
        ("1.5", "-600.0", "parameters_px: expected a correction that neither folds nor mirrors"),
    ],
)
def test_a_wrong_correction_is_refused_with_the_field(was: str, becomes: str, says: str) -> None:
    assert was in written()
    with pytest.raises(FormatError, match=says):
        parse_correction(written().replace(was, becomes, 1))


@pytest.mark.parametrize("size", range(0, 800, 40))
def test_a_truncated_correction_is_a_format_error(size: int) -> None:
    with pytest.raises(FormatError):
        parse_correction(written()[: min(size, len(written()) - 3)])


def test_an_rpc_that_does_not_fit_the_model_is_refused_with_its_error() -> None:
    shape, heights_m = (40_000, 2000), (50.0, 850.0)
    target = np.array([5.4, 43.6, 300.0])
    smooth, shaking = (
        CorrectedModel(
            pushbroom_over(target, shape, 0.5, (25.0, 110.0), heights_m, jitter_px=jitter_px),
            replace(no_correction(shape), parameters=CORRECTION.parameters),
        )
        for jitter_px in (0.0, 3.0)
    )
    followed, refused = refined_rpc(smooth, shape), refined_rpc(shaking, shape)
    assert followed.model is not None
    assert followed.max_error_px < REFIT_LIMIT_PX < 0.1 < refused.max_error_px
    assert refused.model is None


def test_the_refined_model_of_an_ortho_scene_is_its_map_grid(registered, tmp_path: Path) -> None:
    path = tmp_path / "map.tif"
    with rasterio.open(
        path, "w", "GTiff", 60, 50, 1, "EPSG:32631", Affine(10.0, 0.0, 5e5, 0.0, -10.0, 48e5), np.uint8
    ) as file:
        file.write(np.ones((1, 50, 60), np.uint8))
    scene = read_scene(path, sigma_m=10.0)
    shape = scene.image.shape
    correction = replace(no_correction(shape), parameters=CORRECTION.parameters)
    model = CorrectedModel(scene.model, correction)
    adjustment = replace(registered().adjustment, correction=correction, order="affine")
    left = write_refined(
        ImageFiles(path), model, adjustment, shape=shape, folder=tmp_path / "out", copy_image=True
    )
    assert [file.name for file in left.files] == ["correction.json", "map.tif.aux.xml", "map.tif"]
    assert left.max_error_px == 0.0
    corner = np.array([[-0.5, -0.5]])
    placed = read_scene(tmp_path / "out" / "map.tif", sigma_m=10.0).model
    assert np.abs(placed.project(model.locate(corner, np.zeros(1))) - corner).max() < A_MICROMETRE


@pytest.mark.parametrize(("stated_px", "written"), [(0.5, False), (20.0, True)])
def test_an_rpc_that_misses_more_than_is_stated_is_not_written(
    registered, tmp_path: Path, stated_px: float, written: bool
) -> None:
    """Twelve lines were repeated: the verdict is of the correction, and people take the RPC for it."""
    image = write_image(tmp_path / "a.tif", CROP, shape=(400, 300))
    line = np.array([0.0, 199.0, 200.0, 399.0])
    step = np.zeros((4, 2, 2))
    step[2:, :, 0] = 12.0
    grid = DisplacementGrid(line, np.array([0.0, 299.0]), step, np.zeros((4, 2, 2)))
    correction = replace(no_correction((400, 300)), displacement=grid)
    model = CorrectedModel(CROP, correction)
    adjustment = replace(registered().adjustment, correction=correction)
    stated = Stated(ce90_px=stated_px)
    left = write_refined(
        ImageFiles(image), model, adjustment, shape=(400, 300), folder=tmp_path / "o", stated=stated
    )
    assert left.max_error_px > 2.0
    names = {file.name for file in left.files}
    assert ("refined_RPC.TXT" in names) == ("a_RPC.TXT" in names) == written
    assert "correction.json" in names
    assert ("OFF" if written else "no refined RPC is written") in left.note
    assert {path.name for path in (tmp_path / "o").iterdir()} == names


@pytest.mark.parametrize(
    ("off_px", "stated_px", "says"),
    [
        (0.09, 0.0, "refined_RPC.TXT"),
        (0.11, 0.0, "WARNING: more than 0.1 px off"),
        (0.49, 0.2, "WARNING: more than 0.1 px off"),
        (0.51, 0.2, "no refined RPC is written"),
        (0.69, 0.7, "WARNING: more than 0.1 px off"),
        (0.71, 0.7, "no refined RPC is written"),
    ],
)
def test_an_rpc_fitted_to_a_rigorous_model_warns_or_is_left_out_the_farther_it_is_off(
    registered, tmp_path: Path, off_px: float, stated_px: float, says: str
) -> None:
    """Beyond half a pixel where no more is stated, and with a warning beyond a tenth."""
    image = write_image(tmp_path / "a.tif")
    model = AdjustedRigorous(CROP, (100.0, 700.0), 0.02, RefinedRpc(CROP, off_px))
    left = write_refined(
        ImageFiles(image),
        model,
        registered().adjustment,
        shape=(60, 80),
        folder=tmp_path / "out",
        stated=Stated(ce90_px=stated_px),
    )
    assert left.note.startswith(says)
    assert left.max_error_px == off_px
    assert (len(left.files) == 1) == says.startswith("no refined")
