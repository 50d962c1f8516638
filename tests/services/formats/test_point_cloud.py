"""Points of a surface as LAS and LAZ, block after block, as another library reads them."""

from pathlib import Path

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.formats.point_cloud import STEP_M, CloudPoints, write_point_cloud
from amers.services.map_grid import MapGrid

laspy = pytest.importorskip("laspy")

GRID = MapGrid("EPSG:32631", np.array([5e5, 4.8e6]), np.array([[0.0, 0.5], [-0.5, 0.0]]), (40, 60))


def block(count: int, seed: int) -> CloudPoints:
    rng = np.random.default_rng(seed)
    xy_h = np.column_stack(
        [GRID.origin_xy + rng.uniform(-50.0, 50.0, (count, 2)), rng.normal(300.0, 9.0, count)]
    )
    return CloudPoints(
        xy_h, rng.random(count).astype(np.float32), rng.integers(0, 9, count).astype(np.uint8)
    )


@pytest.mark.parametrize("name", ["cloud.laz", "cloud.LAS"])
def test_every_block_of_points_is_in_the_file_with_its_sigmas_and_views(
    tmp_path: Path, name: str
) -> None:
    blocks = [block(300, 1), block(0, 2), block(17, 3)]
    (tmp_path / name).write_text("an older file")
    assert write_point_cloud(tmp_path / name, GRID, iter(blocks)) == 317
    cloud = laspy.read(tmp_path / name)
    expected = np.concatenate([one.xy_h for one in blocks])
    np.testing.assert_allclose(cloud.xyz, expected, atol=0.51 * STEP_M)
    np.testing.assert_array_equal(cloud["sigma_m"], np.concatenate([one.sigma_m for one in blocks]))
    np.testing.assert_array_equal(cloud["views"], np.concatenate([one.views for one in blocks]))
    assert "WGS 84 / UTM zone 31N" in cloud.header.parse_crs().name
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_cloud_that_cannot_be_finished_leaves_the_older_file(tmp_path: Path) -> None:
    def failing():
        yield block(5, 1)
        raise RuntimeError("no more")

    path = tmp_path / "cloud.las"
    path.write_text("an older file")
    with pytest.raises(RuntimeError):
        write_point_cloud(path, GRID, failing())
    assert path.read_text() == "an older file"
    assert [one.name for one in tmp_path.iterdir()] == ["cloud.las"]
    with pytest.raises(InputError, match=r"ends with \.laz or \.las"):
        write_point_cloud(tmp_path / "cloud.txt", GRID, [])
