"""Marks in other formats than CSV, in images of a block, and in images with orbits and attitudes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.app.usecases.control_experiment import ExperimentOptions, run_experiment
from amers.app.usecases.marks_in_images import MarkedImages
from amers.app.usecases.point_intersection import PointIntersection, intersect_files
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.errors import InputError
from amers.services.formats.block.writer import write_block
from amers.services.formats.gcp.json_formats import format_opf
from amers.services.formats.gcp.marked_points import marked_points
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.gcp.text_formats import format_asp_gcp
from amers.services.formats.images.raster import write_raster
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import TOUTIN
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array, Frame
from tests.app.test_point_intersection import a_decimetre, truth
from tests.factories import BOX, GSDS_M, control_points, metadata, noise_chips
from tests.services.formats.sensor_models.simulated_metadata import dimap_v2
from tests.services.simulated import ring_of_geometries
from tests.services.ties import difference_m

NAMES = ("IMG_00", "IMG_01", "IMG_02")
PLACE = np.array([5.4, 43.6, 100.0])
VIEWS = ((2.0, 100.0), (20.0, 100.0), (18.0, 280.0))
SHAPE, GSD_M, HEIGHTS_M = (1200, 1500), 10.0, (0.0, 600.0)
SIGMA_M, NOISE_PX, POINT_M = 100.0, 0.2, 1.5


def rows(models: Sequence[SensorModel], ground: Array, rng: np.random.Generator) -> list[list[object]]:
    """Rows of id, image, line, sample, lon, lat, height_m."""
    out: list[list[object]] = []
    for name, model in zip(NAMES, models, strict=True):
        at = model.project(ground)
        at += rng.normal(0.0, NOISE_PX, at.shape)
        for p, (line, sample) in enumerate(at.tolist()):
            out.append([f"P{p:02}", name, line, sample, *map(repr, ground[p].tolist())])
    return out


def csv(path: Path, lines: list[list[object]]) -> Path:
    head = "# pixel-origin=centre heights=ellipsoid\nid,image,line,sample,lon,lat,height_m\n"
    path.write_text(head + "\n".join(",".join(map(str, line)) for line in lines) + "\n")
    return path


def positions(result: PointIntersection) -> Array:
    return np.array([(point.lon, point.lat, point.height_m) for point in result.points])


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("ring")
    paths = tuple(folder / f"{name}.tif" for name in NAMES)
    for path, geometry in zip(paths, ring_of_geometries(3), strict=True):
        moved = replace(geometry.rpc, image_offset=geometry.rpc.image_offset + 20.0)
        write_raster(path, np.ones(geometry.plan.shape, np.uint8), moved)
    return paths


def test_marks_of_asp_and_opf_give_what_those_of_a_csv_do(
    images: tuple[Path, ...], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    ground = truth(6, rng)
    lines = rows([geometry.rpc for geometry in ring_of_geometries(3)], ground, rng)
    lines.sort(key=lambda line: str(line[0]))
    marks = marked_points(
        [str(line[0]) for line in lines],
        np.repeat(ground, 3, axis=0),
        np.array([line[2:4] for line in lines], dtype=np.float64),
        sigma_m=np.ones((18, 3)),
        sigma_px=np.full(18, NOISE_PX),
        image=[f"{line[1]}.tif" for line in lines],
    )
    (tmp_path / "marks.gcp").write_text(format_asp_gcp(marks))
    (tmp_path / "marks.json").write_text(format_opf(marks))
    files = MarkedImages((csv(tmp_path / "marks.csv", lines),), images, mark_sigma_px=NOISE_PX)
    expected = positions(intersect_files(files))
    stated = StatedByCaller("ellipsoid")
    for name, of in (("marks.gcp", stated), ("marks.json", StatedByCaller())):
        result = intersect_files(replace(files, marks=(tmp_path / name,), stated=of))
        assert np.abs(difference_m(positions(result), expected)).max() < a_decimetre / 10.0
        assert result.known_ground is not None
        assert result.known_ground.points == 6


def test_images_of_a_block_have_its_models_and_its_frame(
    images: tuple[Path, ...], tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    ground = truth(6, rng)
    models = {name: geometry.rpc for name, geometry in zip(NAMES, ring_of_geometries(3), strict=True)}
    points = control_points(4, rng, BOX, 3, GSDS_M)
    framed = replace(metadata(), frame=Frame.from_sigmas(1.0, 2.0))
    write_block(tmp_path / "block", framed, points, noise_chips(points), models)
    file = csv(tmp_path / "marks.csv", rows(list(models.values()), ground, rng))
    files = MarkedImages((file,), images, block=tmp_path / "block", mark_sigma_px=NOISE_PX)
    result = intersect_files(files)
    assert result.relative.label == "Relative to the block"
    assert np.abs(difference_m(positions(result), ground)).max() < 15.0 * a_decimetre
    added = np.array([p.on_the_earth_covariance_m2 for p in result.points])
    added -= np.array([p.covariance_m2 for p in result.points])
    np.testing.assert_allclose(np.sqrt(np.diagonal(added, 0, 1, 2)), [[1.0, 1.0, 2.0]] * 6, rtol=1e-6)
    with pytest.raises(InputError, match="describe delivered models"):
        intersect_files(replace(files, sigma_m=("3",)))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple[Path, ...], list[SensorModel]]:
    """Images with DIMAP metadata, and where they truly are: off as those of SPOT."""
    folder = tmp_path_factory.mktemp("orbits")
    rng = np.random.default_rng(3)
    paths, models = [], []
    for name, view in zip(NAMES, VIEWS, strict=True):
        delivered = pushbroom_over(PLACE, SHAPE, GSD_M, view, HEIGHTS_M)
        free = rigorous_parameters(name, delivered, TOUTIN, sigma_m=SIGMA_M)
        models.append(free.corrected(rng.normal(0.0, free.sigma)))
        paths.append(folder / f"{name}.tif")
        write_raster(paths[-1], np.ones(SHAPE, np.uint8))
        (folder / f"DIM_{name.removeprefix('IMG_')}.XML").write_text(dimap_v2(delivered))
    return tuple(paths), models


@pytest.mark.long
def test_orbits_on_marks_leave_what_marks_and_survey_do(
    scenes: tuple[tuple[Path, ...], list[SensorModel]], tmp_path: Path
) -> None:
    """Three SPOT-like views on six control points, as Toutin and Carbonneau had them."""
    paths, models = scenes
    rng = np.random.default_rng(4)
    at = rng.uniform(0.1, 0.9, (26, 2)) * SHAPE
    ground = models[0].locate(at, rng.uniform(*HEIGHTS_M, 26))
    file = csv(tmp_path / "marks.csv", rows(models, ground, rng))
    files = MarkedImages(
        (file,), paths, rigorous="toutin", sigma_m=(str(SIGMA_M),), mark_sigma_px=NOISE_PX
    )
    once = ExperimentOptions(draws=1)
    result = run_experiment(files, (POINT_M, POINT_M), (0, 6), once).rows
    rms = {(len(row.images), row.control_points): np.array(row.rms_m) for row in result}
    print({key: np.round(value, 1).tolist() for key, value in rms.items()})
    assert (rms[3, 0][:2] > 10.0).all()
    # Two metres of pointing, over a base of 0.7, and three times the noise where control is sparse.
    assert (rms[3, 6] < 3.0 * NOISE_PX * GSD_M / 0.7).all()
    positions_m = positions(intersect_files(files))
    assert np.abs(difference_m(positions_m, ground)).max() < 5.0 * SIGMA_M / 0.7
