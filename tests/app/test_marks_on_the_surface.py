"""Marks for other tools lie on the surface, where the refined model shows it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.app.config import Settings
from amers.app.storage import Storage
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.gcp.reader import read_control_points
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.types import ChipArray, SurfaceHeights
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.command_line import Done, amers_here, environment_of

pytestmark = [pytest.mark.long, pytest.mark.thorough]

ROOF_M, ROOF_SIGMA_M = 12.0, 0.7
a_hundredth_of_a_pixel = 0.01


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A flat world whose block states roofs at every second point, and no surface at the others."""
    folder = tmp_path_factory.mktemp("roofs")
    flat = make_flat_world(folder / "flat")
    made = read_block(flat.block)
    chips = FolderChips(flat.block)
    roof = np.arange(len(made.points)) % 2 == 0
    surface = SurfaceHeights(
        np.where(roof, made.points.lon_lat_h[:, 2] + ROOF_M, np.nan),
        np.where(roof, ROOF_SIGMA_M, np.nan),
    )

    def of_point(row: int) -> ChipArray:
        first, count = int(made.points.chip_row[row]), np.diff(made.points.views.start)[row]
        return chips.read(made.points.chip_files[made.points.chip_file[row]], first, int(count))

    points = replace(made.points, surface=surface)
    write_block(folder / "block", made.document.metadata, points, of_point, {})
    return replace(flat, block=folder / "block")


@pytest.fixture
def amers(settings: Settings) -> Callable[..., Done]:
    """Runs the command `amers` on the installation of the test."""
    return lambda *words: amers_here(words, environment_of(settings))


@pytest.mark.parametrize("from_store", [False, True])
def test_marks_have_the_height_of_the_surface_and_their_residuals(
    amers: Callable[..., Done],
    world: FlatWorld,
    dsn: str,
    storage: Storage,
    tmp_path: Path,
    from_store: bool,
) -> None:
    folder = tmp_path / "out"
    control: tuple[object, ...] = ("--block", world.block)
    if from_store:
        publish_world(dsn, storage, world)
        control = ()
    result = amers(
        "scene", "register", world.tagged, *control, "--sigma-m", SIGMA_M, "-o", folder, "--json"
    )
    assert result.returncode == 0, result.stderr
    as_found = read_control_points(folder / "control_points.geojson")
    as_found = as_found.take(as_found.active)
    marks = read_control_points(folder / "control_points_opf.json")
    assert len(marks) == len(as_found) > 10
    roof = marks.lon_lat_h[:, 2] - as_found.lon_lat_h[:, 2]
    assert np.isclose(roof, 0.0).any()
    assert np.isclose(roof, ROOF_M).any()
    assert (np.isclose(roof, 0.0) | np.isclose(roof, ROOF_M)).all()
    assert (marks.lon_lat_h[:, :2] == as_found.lon_lat_h[:, :2]).all()
    on_roof = np.isclose(roof, ROOF_M)
    assert marks.sigma_m[on_roof, 2] == pytest.approx(ROOF_SIGMA_M)
    assert (marks.sigma_m[~on_roof, 2] < ROOF_SIGMA_M / 2.0).all()
    # The residual of each mark is that of its measure.
    model = read_rpc(world.tagged, folder / "tagged_RPC.TXT").model
    residual_px = marks.line_sample - model.project(marks.lon_lat_h)
    before_px = as_found.line_sample - model.project(as_found.lon_lat_h)
    assert np.abs(residual_px - before_px).max() < a_hundredth_of_a_pixel
    moved = np.linalg.norm(marks.line_sample - as_found.line_sample, axis=1)
    assert (moved[on_roof] > 0.2).all()
    assert (moved[~on_roof] == 0.0).all()
