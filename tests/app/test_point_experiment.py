"""`amers points experiment`: check points by control points, images and base, as a survey would find."""

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from amers.app.errors import InputError
from amers.app.usecases.control_experiment import ExperimentOptions, ExperimentRow, run_experiment
from amers.app.usecases.marks_in_images import MarkedImages
from amers.services.errors import NotEnoughPoints
from amers.services.formats.images.raster import write_raster
from amers.services.geodesy import move_metres
from tests.app.test_point_intersection import NAMES, NOISE_PX, marks, table, truth
from tests.command_line import amers_here
from tests.services.simulated import ring_of_geometries

OFF_M = 3.0
POINT_M = 0.2
a_tenth_of_a_millimetre = 1e-4
KNOWN, TIES = 20, 5
HEAD = "id,image,line,sample,lon,lat,height_m"
TWICE = ExperimentOptions(draws=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images off by some metres, and marks of 20 known points and five others."""
    folder = tmp_path_factory.mktemp("experiment")
    for name, geometry in zip(NAMES, ring_of_geometries(3), strict=True):
        write_raster(folder / f"{name}.tif", np.ones(geometry.plan.shape, np.uint8), geometry.rpc)
    rng = np.random.default_rng(11)
    ground = truth(KNOWN + TIES, rng)
    known = move_metres(ground, rng.normal(0.0, POINT_M, ground.shape))
    rows = []
    for name, image, line, sample in marks(folder, ground, rng, OFF_M):
        number = int(name[1:])
        position = [repr(v) for v in known[number].tolist()] if number < KNOWN else ["", "", ""]
        rows.append([name, image, line, sample, *position])
    table(folder / "marks.csv", rows, HEAD)
    return folder


def files(folder: Path, marked: str = "marks.csv") -> MarkedImages:
    images = tuple(folder / f"{name}.tif" for name in NAMES)
    return MarkedImages((folder / marked,), images, sigma_m=(str(OFF_M),))


def by(rows: list[ExperimentRow]) -> dict[tuple[int, int], np.ndarray]:
    """Root mean squares over all rows of a number of images and of control points."""
    return {
        key: np.sqrt(np.mean([np.square(row.rms_m) for row in rows if kind(row) == key], axis=0))
        for key in {kind(row) for row in rows}
    }


def kind(row: ExperimentRow) -> tuple[int, int]:
    return len(row.images), row.control_points


def test_more_control_and_more_images_leave_smaller_errors(folder: Path) -> None:
    result = run_experiment(files(folder), (POINT_M, POINT_M), (0, 3, 12), TWICE)
    assert (result.points, result.ties, result.notes) == (KNOWN, TIES, [])
    subsets = [list(one) for size in (1, 2, 3) for one in combinations(NAMES, size)]
    assert [row.images for row in result.rows[::3]] == subsets
    assert all(row.reason == "" for row in result.rows)
    rms = by(result.rows)
    print({key: np.round(value, 2).tolist() for key, value in sorted(rms.items())})
    for images in (2, 3):
        assert rms[images, 12][2] < rms[images, 3][2] < rms[images, 0][2]
    assert rms[3, 12][2] < rms[2, 12][2]
    assert np.isnan(rms[1, 12][2])
    # What marks and survey alone leave: height by half a pixel of a metre over a base of 0.46.
    assert rms[2, 12][2] < 1.6 * np.hypot(np.sqrt(2.0) * NOISE_PX / 0.46, POINT_M)
    assert (rms[3, 12][:2] < 1.6 * np.hypot(NOISE_PX, POINT_M)).all()


def test_ground_of_check_points_has_no_part_in_any_model(folder: Path) -> None:
    """A check point that is 50 m too high is off by that, and leaves all models as they were."""
    lines = (folder / "marks.csv").read_text().splitlines()
    raised = []
    for line in lines:
        fields = line.split(",")
        if fields[0] == "P007":
            fields[6] = str(float(fields[6]) + 50.0)
        raised.append(",".join(fields))
    (folder / "raised.csv").write_text("\n".join(raised) + "\n")
    once = ExperimentOptions(draws=1)
    right, wrong = (
        run_experiment(files(folder, name), (POINT_M, POINT_M), (4,), once).rows
        for name in ("marks.csv", "raised.csv")
    )
    for one, other in zip(right[3:], wrong[3:], strict=True):
        assert other.worst == "P007"
        assert other.worst_m == pytest.approx(50.0, abs=10.0)
        # Where a point is intersected does not depend on what is known of it.
        np.testing.assert_allclose(other.rms_m[:2], one.rms_m[:2], atol=a_tenth_of_a_millimetre)


def test_a_point_with_a_wrong_mark_is_left_out_whether_its_ground_is_known_or_not(folder: Path) -> None:
    wrong = {f"P{number:03}": "left" for number in (4, KNOWN + 1)}
    lines = []
    for line in (folder / "marks.csv").read_text().splitlines():
        fields = line.split(",")
        if [wrong.get(fields[0])] == fields[1:2]:
            fields[2:4] = [str(float(value) + 9.0) for value in fields[2:4]]
        lines.append(",".join(fields))
    (folder / "wrong.csv").write_text("\n".join(lines) + "\n")
    result = run_experiment(files(folder, "wrong.csv"), (POINT_M, POINT_M), (4,), TWICE)
    assert (result.points, result.ties) == (KNOWN - 1, TIES - 1)
    assert [note.partition(":")[0] for note in result.notes] == [f"point {name}" for name in wrong]


def test_what_is_not_stated_or_too_little_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"20 points, such as P000, have no sigma .*--point-sigma-m"):
        run_experiment(files(folder), None)
    with pytest.raises(NotEnoughPoints, match="20 usable points found, 33 needed"):
        run_experiment(files(folder), (POINT_M, POINT_M), (30,))


def test_the_command_prints_a_table_and_json(folder: Path) -> None:
    words = ["points", "experiment", str(folder / "marks.csv"), "--sigma-m", str(OFF_M)]
    words += [word for name in NAMES for word in ("--images", str(folder / f"{name}.tif"))]
    words += ["--point-sigma-m", "0.2,0.2", "--draws", "1"]
    shown = amers_here([*words, "--control-points", "0,4"], {})
    assert shown.returncode == 0, shown.stderr
    lines = shown.stdout.splitlines()
    assert lines[0].split("\t")[:3] == ["images", "b_h", "control"]
    assert len(lines) == 1 + 2 * 7
    document = json.loads(amers_here([*words, "--control-points", "0", "--json"], {}).stdout)
    assert document["rows"][0]["rms_m"][2] is None
    refused = amers_here([*words, "--control-points", "few"], {})
    assert "--control-points: 'few' found, numbers expected" in refused.stderr


def test_one_control_point_places_an_image_and_a_block(folder: Path) -> None:
    result = run_experiment(files(folder), (POINT_M, POINT_M), (0, 1), TWICE)
    assert [row.reason for row in result.rows] == [""] * len(result.rows)
    rms = by(result.rows)
    assert rms[1, 1][:2].mean() < 0.5 * rms[1, 0][:2].mean()
