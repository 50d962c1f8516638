"""`amers points intersect`: truth within the stated accuracy, and all that disagrees by name."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest

from amers.app.errors import InputError
from amers.app.usecases.marks_in_images import MarkedImages, read_image_marks
from amers.app.usecases.point_intersection import PointIntersection, intersect_files
from amers.services.errors import NotEnoughPoints
from amers.services.formats.gcp.reader import StatedByCaller, read_ground_points
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.geodesy import metres_per_degree_at, move_metres
from amers.services.imagery.source import Window
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import no_correction
from amers.services.types import Array, Frame
from tests.command_line import amers_here
from tests.journeys.ties import independent_tracks
from tests.services.simulated import ring_of_geometries, world
from tests.services.ties import whitened_square

NOISE_PX = 0.5
MODEL_SIGMA_M = 3.0
NAMES = ("nadir", "left", "right")
a_tenth_of_a_millimetre = 1e-4
a_decimetre = 0.1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three empty images with the models of a ring of views."""
    folder = tmp_path_factory.mktemp("marked")
    for name, geometry in zip(NAMES, ring_of_geometries(3), strict=True):
        write_raster(folder / f"{name}.tif", np.ones(geometry.plan.shape, np.uint8), geometry.rpc)
    return folder


def images(folder: Path, count: int = 3) -> tuple[Path, ...]:
    return tuple(folder / f"{name}.tif" for name in NAMES[:count])


def truth(count: int, rng: np.random.Generator) -> Array:
    geometry = ring_of_geometries(3)[0]
    at = rng.uniform(0.15, 0.85, (count, 2)) * geometry.plan.shape
    return geometry.true_model.locate(at, rng.uniform(*world().height_range_m, count))


def marks(folder: Path, ground: Array, rng: np.random.Generator, off_m: float = 0.0) -> list[list[Any]]:
    """Rows of id, image, line, sample, as people mark ground in images whose models are off."""
    rows: list[list[Any]] = []
    for name in NAMES:
        model = read_scene(folder / f"{name}.tif", sigma_m=1.0).model
        step = np.append(rng.normal(0.0, off_m, 2), 0.0) if off_m else np.zeros(3)
        at = model.project(move_metres(ground, np.tile(step, (len(ground), 1))))
        at += rng.normal(0.0, NOISE_PX, at.shape)
        rows += [[f"P{p:03}", name, *position] for p, position in enumerate(at.tolist())]
    return rows


def table(path: Path, rows: Sequence[Sequence[Any]], head: str = "id,image,line,sample") -> Path:
    lines = ["# pixel-origin=centre heights=ellipsoid", head]
    path.write_text("\n".join([*lines, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def of(result: PointIntersection, ground: Array) -> tuple[Array, Array, Array]:
    """Errors (n, 3) of points P000 and on, and their covariances, relative and on the Earth."""
    rows = [int(point.id[1:]) for point in result.points]
    found = np.array([(point.lon, point.lat, point.height_m) for point in result.points])
    error = found - ground[rows]
    error[:, :2] *= metres_per_degree_at(ground[rows])
    relative, earth = (
        np.array([getattr(point, name) for point in result.points])
        for name in ("covariance_m2", "on_the_earth_covariance_m2")
    )
    return error, relative, earth


@pytest.mark.parametrize("count", [2, 3])
def test_errors_of_points_are_within_their_stated_accuracy(
    folder: Path, tmp_path: Path, count: int
) -> None:
    rng = np.random.default_rng(1)
    earth_square, apart_square = [], []
    for _ in range(12):
        ground = truth(40, rng)
        rows = [row for row in marks(folder, ground, rng, MODEL_SIGMA_M) if row[1] in NAMES[:count]]
        file = table(tmp_path / "marks.csv", rows)
        result = intersect_files(
            MarkedImages((file,), images(folder, count), sigma_m=(str(MODEL_SIGMA_M),))
        )
        assert len(result.points) == 40
        error, relative, earth = of(result, ground)
        earth_square.append(whitened_square(error, earth).mean())
        apart = error - error.mean(axis=0)
        apart_square.append(whitened_square(apart, relative * 39 / 40).mean())
    print(f"{count} images: {np.mean(earth_square):.2f} on the Earth, {np.mean(apart_square):.2f} apart")
    assert 0.7 < np.mean(earth_square) < 1.5
    assert 0.9 < np.mean(apart_square) < 1.1


def test_a_wrong_mark_is_named_with_its_image_in_three_images_and_not_in_two(
    folder: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    ground = truth(15, rng)
    rows = marks(folder, ground, rng, MODEL_SIGMA_M)
    wrong = rows[NAMES.index("left") * 15 + 4]
    wrong[2] += 6.0
    wrong[3] += 7.0
    file = table(tmp_path / "marks.csv", rows)
    result = intersect_files(MarkedImages((file,), images(folder), sigma_m=("3",)))
    assert [(one.id, one.image) for one in result.wrong_marks] == [("P004", "left")]
    assert any("P004: its mark in left is" in note for note in result.notes)
    assert len(result.points) == 15
    assert result.points[4].images == 2
    assert result.points[4].largest_residual_image == "left"
    pair = table(tmp_path / "pair.csv", [row for row in rows if row[1] != "right"])
    two = intersect_files(MarkedImages((pair,), images(folder, 2), sigma_m=("3",)))
    assert two.wrong_marks == []
    assert any(note.startswith("15 of 15 points are marked in two images") for note in two.notes)
    assert "P004" in two.disagreeing
    assert not any("residuals are" in note for note in result.notes)


def test_marks_in_one_image_are_left_out_by_name(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rows = marks(folder, truth(5, rng), rng)
    lone = [row for row in rows if row[0] != "P002" or row[1] == "nadir"]
    result = intersect_files(MarkedImages((table(tmp_path / "m.csv", lone),), images(folder)))
    assert result.left_out == {"P002": "marked in one image alone, nadir"}
    assert [point.id for point in result.points] == ["P000", "P001", "P003", "P004"]
    none = table(tmp_path / "n.csv", rows[:5])
    with pytest.raises(NotEnoughPoints, match="none of 5 points is marked in two images"):
        intersect_files(MarkedImages((none,), images(folder)))


def test_what_cannot_be_used_is_refused(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    rows = marks(folder, truth(4, rng), rng)
    file = table(tmp_path / "marks.csv", rows)
    with pytest.raises(InputError, match=r"marks in right, expected names of the images given: left"):
        intersect_files(MarkedImages((file,), images(folder, 2)))
    with pytest.raises(InputError, match="two at least expected"):
        intersect_files(MarkedImages((file,), images(folder, 1)))
    twice = table(tmp_path / "twice.csv", [*rows, ["P001", "left", 10, 10]])
    with pytest.raises(InputError, match="P001: marked twice in left"):
        intersect_files(MarkedImages((twice,), images(folder)))
    with pytest.raises(InputError, match=r"--sigma-m: 'far' found, metres above 0"):
        intersect_files(MarkedImages((file,), images(folder), sigma_m=("nadir=far",)))
    with pytest.raises(InputError, match=r"\.shp found, one of \.csv"):
        intersect_files(MarkedImages((file,), images(folder)), tmp_path / "points.shp")


def test_known_ground_is_compared_and_of_it_the_check_points_alone_where_there_are_any(
    folder: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    ground = truth(10, rng)
    off_m = np.array([0.0, 0.0, 40.0])
    rows = []
    for name, image, line, sample in marks(folder, ground, rng):
        number = int(name[1:])
        known = ground[number] + (off_m if number == 9 else 0.0)
        position = ["", "", ""] if number < 3 else [repr(value) for value in known.tolist()]
        rows.append([name, image, line, sample, *position, int(number in (5, 6))])
    head = "id,image,line,sample,lon,lat,height_m,check"
    files = MarkedImages((table(tmp_path / "m.csv", rows, head),), images(folder), sigma_m=("0.01",))
    result = intersect_files(files)
    assert result.known_ground is not None
    assert result.known_ground.points == 2
    assert result.points[0].error_m is None
    assert result.points[9].error_m is not None
    assert result.points[9].error_m[2] == pytest.approx(-40.0, abs=10.0 * NOISE_PX)
    no_flag = [row[:-1] for row in rows]
    file = table(tmp_path / "all.csv", no_flag, head.removesuffix(",check"))
    every = intersect_files(replace(files, marks=(file,))).known_ground
    assert every is not None
    assert every.points == 7
    assert every.rms_m[2] == pytest.approx(40.0 / np.sqrt(7.0), rel=0.1)


def test_ground_is_that_of_the_first_file_that_states_it(folder: Path, tmp_path: Path) -> None:
    """Of four points, one file knows the first two, another the second and the third, none the last."""
    rng = np.random.default_rng(4)
    ground = truth(4, rng)
    files = []
    for name, known in (("left", (0, 1)), ("right", (1, 2))):
        rows = [row for row in marks(folder, ground, rng) if row[1] == name]
        for number, row in enumerate(rows):
            row += ground[number].tolist() if number in known else ["", "", ""]
        files.append(table(tmp_path / f"{name}.csv", rows, "id,image,line,sample,lon,lat,height_m"))
    for first, second in (files, files[::-1]):
        read = read_image_marks(MarkedImages((first, second), images(folder)))
        expected = {files[0]: [0, 0, 1, -1], files[1]: [1, 0, 0, -1]}[first]
        assert read.file.tolist() == expected
        np.testing.assert_allclose(read.known[:3], ground[:3], atol=1e-8)
        assert np.isnan(read.known[3]).all()


def register(folder: Path, covariance_px2: Array) -> None:
    """Write the registrations of the images, none of which is corrected."""
    for name, geometry in zip(NAMES, ring_of_geometries(3), strict=True):
        (folder / name).mkdir(parents=True)
        accuracy = CorrectionAccuracy(
            no_correction(geometry.plan.shape), covariance_px2, np.zeros(2), Frame.from_sigmas(2.0, 3.0)
        )
        order = "affine" if covariance_px2[1, 1] else "shift"
        text = format_correction(accuracy, order, applies_to=f"{name}.tif", carried="approximately")
        (folder / name / "correction.json").write_text(text)


def test_the_names_of_points_and_the_order_of_rows_change_nothing(folder: Path, tmp_path: Path) -> None:
    """Errors of registered models grow towards the edges of the images: no point counts more."""
    rng = np.random.default_rng(9)
    rows = marks(folder, truth(5, rng), rng)
    register(tmp_path / "registered", np.diag([0.01, 0.09, 0.04, 0.02, 0.05, 0.08]))
    renamed = [[f"P{4 - int(name[1:]):03}", *row] for name, *row in rows[::-1]]
    found = []
    for file, given in (("one.csv", rows), ("other.csv", renamed)):
        files = MarkedImages((table(tmp_path / file, given),), images(folder))
        found.append(intersect_files(replace(files, registered=tmp_path / "registered")).points)
    for point, same in zip(found[0], found[1][::-1], strict=True):
        assert (point.lon, point.lat, point.height_m) == pytest.approx(
            (same.lon, same.lat, same.height_m), abs=1e-9
        )
        np.testing.assert_allclose(point.covariance_m2, same.covariance_m2, rtol=1e-6)


def test_registered_models_bring_their_own_errors_and_those_of_the_control(
    folder: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(6)
    ground = truth(6, rng)
    file = table(tmp_path / "marks.csv", marks(folder, ground, rng))
    register(tmp_path / "registered", np.diag([0.09, 0.0, 0.0, 0.09, 0.0, 0.0]))
    result = intersect_files(MarkedImages((file,), images(folder), registered=tmp_path / "registered"))
    assert result.relative.label == "Relative to the control points"
    for point in result.points:
        added = np.array(point.on_the_earth_covariance_m2) - np.array(point.covariance_m2)
        np.testing.assert_allclose(np.sqrt(np.diag(added)), [2.0, 2.0, 3.0], rtol=1e-6)
    marks_alone = intersect_files(MarkedImages((file,), images(folder)))
    for one, other in zip(result.points, marks_alone.points, strict=True):
        assert (np.array(one.sigma_m) > other.sigma_m).all()


@pytest.mark.parametrize("suffix", [".csv", ".geojson", ".gpkg"])
def test_the_command_prints_and_writes_points_that_can_be_read_again(
    folder: Path, tmp_path: Path, suffix: str
) -> None:
    rng = np.random.default_rng(7)
    ground = truth(6, rng)
    file = table(tmp_path / "marks.csv", marks(folder, ground, rng))
    output = tmp_path / f"points{suffix}"
    words = ["points", "intersect", str(file), *(f"--images={one}" for one in images(folder))]
    shown = amers_here([*words, "--sigma-m", "3", "-o", str(output), "--json"], {})
    assert shown.returncode == 0, shown.stderr
    points = json.loads(shown.stdout)["points"]
    if suffix == ".gpkg":
        meta, _, _, fields = pyogrio.raw.read(output)
        assert dict(zip(meta["fields"], fields, strict=True))["id"].tolist() == [p["id"] for p in points]
        return
    again = read_ground_points(output, StatedByCaller())
    stated = np.array([(p["lon"], p["lat"], p["height_m"]) for p in points])
    assert (np.abs(again.lon_lat_h - stated) * [1e5, 1e5, 1.0]).max() < 2.0 * a_tenth_of_a_millimetre
    np.testing.assert_allclose(again.sigma_m, [p["sigma_m"] for p in points], rtol=1e-6)
    people = amers_here([*words, "--sigma-m", "3"], {})
    assert "Relative to the models" in people.stdout
    assert "the images are not registered" in people.stderr


@pytest.mark.real_data
def test_points_of_two_real_views_are_where_the_third_sees_them(real_data: Path, tmp_path: Path) -> None:
    """Pléiades over the Calanques: details matched without any model, intersected from two views."""
    names = [f"img_0{number}" for number in (1, 2, 3)]
    paths = tuple(real_data / "phr_calanques_triplet" / f"{name}.tif" for name in names)
    scenes = [read_scene(path, sigma_m=1.0) for path in paths]
    pixels = [scene.image.read(Window(0, 0, *scene.image.shape)) for scene in scenes]
    tracks = independent_tracks(pixels)
    rows = [
        [f"P{point:03}", names[image], *position]
        for point, image, position in zip(
            tracks.point.tolist(), tracks.image.tolist(), tracks.line_sample.tolist(), strict=True
        )
    ]
    every = intersect_files(MarkedImages((table(tmp_path / "all.csv", rows),), paths, mark_sigma_px=0.3))
    print(f"{len(every.points)} points, scale {every.scale:.2f}, {len(every.wrong_marks)} wrong marks")
    assert 0.5 < every.scale < 1.5
    assert len(every.wrong_marks) < 0.1 * len(rows)
    wrong = {one.id for one in every.wrong_marks}
    pair = [row for row in rows if row[1] != names[2] and row[0] not in wrong]
    two = intersect_files(
        MarkedImages((table(tmp_path / "pair.csv", pair),), paths[:2], mark_sigma_px=0.3)
    )
    ground = np.array([(p.lon, p.lat, p.height_m) for p in two.points])
    third = {row[0]: row[2:] for row in rows if row[1] == names[2]}
    off = np.array([third[p.id] for p in two.points]) - scenes[2].model.project(ground)
    relative = np.array([p.covariance_m2 for p in two.points])
    by_ground = scenes[2].model.project_derivative(ground)
    stated = by_ground @ relative @ by_ground.transpose(0, 2, 1) + 0.09 * np.eye(2)
    apart = off - np.median(off, axis=0)
    square = whitened_square(apart, stated)
    print(f"third view: {np.median(np.hypot(*apart.T)):.2f} px, mean square {square.mean():.2f}")
    assert 0.4 < square.mean() < 2.0
