"""An Amers block reads back as it was written."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from amers.services.errors import FormatError, InputError
from amers.services.formats.block import writer
from amers.services.formats.block.check import check_block
from amers.services.formats.block.document_json import format_block_json, parse_block_json
from amers.services.formats.block.hilbert import hilbert_order
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.types import ControlPoints, Frame, SurfaceHeights, point_chips
from tests.factories import MadeBlock, affine_model, control_points, make_block, metadata, noise_chips

rounding = 1e-12


@pytest.fixture
def block(tmp_path: Path) -> MadeBlock:
    return make_block(tmp_path / "block")


def assert_same_points(found: ControlPoints, expected: ControlPoints) -> None:
    assert_array_equal(found.id, expected.id)
    assert_array_equal(found.lon_lat_h, expected.lon_lat_h)
    assert_allclose(found.covariance_m2, expected.covariance_m2, rtol=rounding)
    assert_array_equal(found.saliency, expected.saliency)
    assert_array_equal(found.views.start, expected.views.start)
    assert_array_equal(found.views.gsd_m, expected.views.gsd_m)
    assert_array_equal(found.views.image, expected.views.image)
    assert_array_equal(found.views.incidence_deg, expected.views.incidence_deg)
    assert_array_equal(found.views.azimuth_deg, expected.views.azimuth_deg)
    assert repr(found.views.images) == repr(expected.views.images)


def test_a_block_reads_back_as_it_was_written(block):
    contents = check_block(block.folder)

    assert_same_points(contents.points, block.points)
    assert_same_points(read_block(block.folder).points, block.points)
    written, read = block.metadata, contents.document.metadata
    assert_array_equal(read.extent, written.extent)
    assert replace(read, extent=written.extent, frame=written.frame) == written
    assert contents.document.counts.views == len(block.points.views.gsd_m)
    assert (contents.n_views == 3).all()
    assert contents.first_view[0] == np.datetime64("2023-03-01")
    assert contents.last_view[0] == np.datetime64("2023-06-09")
    assert set(contents.typology) == {"crossroads", "building corner", 'a "rare" kind', None}


def test_heights_of_the_surface_read_back_and_may_be_unknown(tmp_path):
    made = make_block(tmp_path / "plain")
    assert read_block(made.folder).points.surface is None
    height_m = np.linspace(100.0, 120.0, len(made.points))
    sigma_m = np.linspace(0.2, 3.0, len(made.points))
    height_m[1] = sigma_m[1] = np.nan
    points = replace(made.points, surface=SurfaceHeights(height_m, sigma_m))
    chips = noise_chips(points)
    write_block(tmp_path / "stated", metadata("stated"), points, chips, {})
    order = hilbert_order(points.lon_lat_h[:, :2])
    surface = check_block(tmp_path / "stated").points.surface
    assert_array_equal(surface.height_m, height_m[order])
    assert_array_equal(surface.sigma_m, sigma_m[order])
    stored = pq.read_table(tmp_path / "stated" / "points.parquet")
    assert stored["surface_height_m"].null_count == stored["surface_sigma_m"].null_count == 1


def test_a_height_of_the_surface_without_a_sigma_is_refused(tmp_path):
    made = make_block(tmp_path / "plain")
    height_m = np.full(len(made.points), 100.0)
    points = replace(made.points, surface=SurfaceHeights(height_m, np.full(len(height_m), np.nan)))
    write_block(tmp_path / "half", metadata("half"), points, noise_chips(points), {})
    with pytest.raises(FormatError, match="surface_sigma_m"):
        check_block(tmp_path / "half")


def test_chips_of_a_folder_are_identical_to_those_written(block):
    contents = read_block(block.folder)
    with FolderChips(block.folder) as chips:
        for row in range(len(contents.points)):
            assert_array_equal(point_chips(contents.points, chips, row), block.chips(row))


@pytest.mark.parametrize(("dtype", "chips_of_a_file"), [(np.uint8, 12), (np.uint16, 17)])
def test_chips_continue_in_a_second_file_without_splitting_a_point(
    tmp_path, monkeypatch, dtype, chips_of_a_file
):
    chip_bytes = 101 * 101 * np.dtype(dtype).itemsize
    monkeypatch.setattr(writer, "CHIP_FILE_BYTES", chips_of_a_file * chip_bytes)

    block = make_block(tmp_path / "block", count=7, dtype=dtype)

    points = check_block(block.folder).points
    assert points.chip_files == tuple(f"chips/{i:04d}.npy" for i in range(4))
    assert_array_equal(points.chip_file, [0, 0, 1, 1, 2, 2, 3])
    with FolderChips(block.folder) as chips:
        for row in range(len(points)):
            assert_array_equal(point_chips(points, chips, row), block.chips(row))
    assert np.load(block.folder / "chips/0003.npy").shape == (6, 101, 101)


def test_the_models_of_images_are_readable_rpc_text(block):
    contents = check_block(block.folder)
    path = contents.document.models[0]
    model = parse_rpc_text((block.folder / path).read_text())
    expected = affine_model(np.array([5.25, 43.25]))
    assert path == "models/IMG_00_RPC.TXT"
    assert_array_equal(model.line_num, expected.line_num)
    assert contents.document.models[1:] == (None, None)


def test_the_points_file_is_geoparquet_of_3d_points_in_epsg_4979(block):
    table = pq.read_table(block.folder / "points.parquet")
    geo = json.loads(table.schema.metadata[b"geo"])
    column = geo["columns"]["geometry"]
    assert geo["version"] == "1.1.0"
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 4979}
    assert column["geometry_types"] == ["Point Z"]
    geometry = shapely.from_wkb(table["geometry"].to_numpy())
    assert_array_equal(shapely.get_coordinates(geometry, include_z=True), block.points.lon_lat_h)


def test_neighbours_in_the_file_are_neighbours_on_the_ground():
    lon_lat = np.random.default_rng(3).uniform(0.0, 1.0, (4000, 2))
    step = np.linalg.norm(np.diff(lon_lat[hilbert_order(lon_lat)], axis=0), axis=1)
    mean_spacing = 1.0 / np.sqrt(len(lon_lat))
    assert step.mean() < 1.2 * mean_spacing


def test_the_hilbert_order_of_a_full_grid_moves_one_step_at_a_time():
    axis = np.arange(16.0)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    walk = np.diff(grid[hilbert_order(grid)], axis=0)
    assert_array_equal(np.abs(walk).sum(axis=1), 1.0)


def test_a_block_is_never_overwritten(block):
    before = (block.folder / "block.json").read_bytes()
    with pytest.raises(InputError, match="never overwritten"):
        make_block(block.folder, seed=2)
    assert (block.folder / "block.json").read_bytes() == before


def test_a_writer_that_fails_leaves_no_files(tmp_path):
    points = control_points(10, np.random.default_rng(1))

    def chips(row: int) -> np.ndarray:
        if row == 5:
            raise RuntimeError("the image vanished")
        return noise_chips(points)(row)

    with pytest.raises(RuntimeError, match="vanished"):
        write_block(tmp_path / "block", metadata(), points, chips, {})
    assert list(tmp_path.iterdir()) == []


def test_chips_of_another_shape_or_type_are_refused(tmp_path):
    points = control_points(3, np.random.default_rng(1))
    good = noise_chips(points)
    for wrong in (lambda i: good(i)[:, :100], lambda i: good(i)[1:], lambda i: good(i).astype(float)):
        with pytest.raises(FormatError, match="expected"):
            write_block(tmp_path / "block", metadata(), points, wrong, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../escape", "a/b", "", ".hidden", "x" * 300])
def test_names_that_are_not_file_names_are_refused(tmp_path, name):
    points = control_points(2, np.random.default_rng(1))
    with pytest.raises(InputError):
        write_block(
            tmp_path / "b", metadata(), points, noise_chips(points), {name: affine_model(np.zeros(2))}
        )
    with pytest.raises(InputError):
        write_block(tmp_path / "b", metadata(name), points, noise_chips(points), {})


def test_a_block_across_the_antimeridian_is_valid(tmp_path):
    block = make_block(tmp_path / "b", box=(179.9, -17.0, -179.9, -16.9))
    contents = check_block(block.folder)
    assert contents.points.lon_lat_h[:, 0].min() < -179.0
    assert contents.points.lon_lat_h[:, 0].max() > 179.0
    document = json.loads((block.folder / "block.json").read_text())
    assert_allclose(document["extent"]["spatial"]["bbox"][0], [179.9, -17.0, -179.9, -16.9])


@pytest.mark.thorough
@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_garbled_documents_raise_nothing_but_format_errors(block_text, data):
    start = data.draw(st.integers(0, len(block_text) - 1))
    end = data.draw(st.integers(start, min(len(block_text), start + 40)))
    garbled = block_text[:start] + data.draw(st.text(max_size=10)) + block_text[end:]
    with suppress(FormatError):
        parse_block_json(garbled)


@pytest.fixture(scope="module")
def block_text(tmp_path_factory) -> str:
    block = make_block(tmp_path_factory.mktemp("text") / "block", count=3)
    return (block.folder / "block.json").read_text()


def test_a_document_reads_back_as_it_was_written(block_text):
    assert format_block_json(parse_block_json(block_text)) == block_text


def test_a_block_states_its_frame_what_its_points_share_and_what_is_assumed(tmp_path):
    covariance_m2 = np.array([[1.8, 0.2, 0.5], [0.2, 1.7, 0.0], [0.5, 0.0, 25.0]])
    shared_m2 = np.array([[0.1, 0.02, 0.0], [0.02, 0.2, 0.05], [0.0, 0.05, 0.4]])
    stated = Frame(covariance_m2, shared_m2, assumed="the accuracy of two models is not stated")
    points = control_points(3, np.random.default_rng(1))
    write_block(tmp_path / "block", replace(metadata(), frame=stated), points, noise_chips(points), {})
    (frame,) = check_block(tmp_path / "block").points.frames
    assert_array_equal(frame.covariance_m2, covariance_m2)
    assert_array_equal(frame.shared_m2, shared_m2)
    assert frame.assumed == stated.assumed


def test_a_frame_is_unknown_where_nothing_or_null_is_stated(block):
    text = (block.folder / "block.json").read_text()
    document = json.loads(text)
    assert document["amers:frame"] is None
    assert np.isnan(parse_block_json(text).metadata.frame.covariance_m2).all()
    del document["amers:frame"]
    assert np.isnan(parse_block_json(json.dumps(document)).metadata.frame.covariance_m2).all()


def test_a_block_that_states_a_sigma_only_leaves_the_height_of_its_frame_unknown(block):
    document = json.loads((block.folder / "block.json").read_text())
    figure = {"name": "frame_sigma_m", "value": 2.0, "count": 3, "against": "models"}
    document["amers:accuracy"]["absolute"] = [figure]
    del document["amers:frame"]
    read = parse_block_json(json.dumps(document))
    assert_array_equal(read.metadata.frame.covariance_m2, Frame.from_sigmas(2.0, np.nan).covariance_m2)
    again = parse_block_json(format_block_json(read))
    assert_array_equal(again.metadata.frame.covariance_m2, read.metadata.frame.covariance_m2)


NO_COVARIANCES = [
    [[1.0, 0.0], [0.0, 1.0]],
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
    [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, None]],
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, "high"]],
    7,
]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("covariance_m2", value) for value in NO_COVARIANCES),
        *(
            ("shared_m2", value)
            for value in ([[1.0]], "0.1 m", [[1, 0, 0], [0, None, 0], [0, 0, 1]], -1)
        ),
        *(("assumed", value) for value in (7, "a" * 301, "a\nb", ["text"])),
    ],
)
def test_a_frame_is_of_covariances_and_a_sentence_or_refused_by_its_member(block_text, name, value):
    document = json.loads(block_text)
    document["amers:frame"] = {"covariance_m2": np.eye(3).tolist(), name: value}
    with pytest.raises(
        FormatError, match="amers:frame" if name == "covariance_m2" else f"amers:frame: {name}"
    ):
        parse_block_json(json.dumps(document))
