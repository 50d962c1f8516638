"""The accuracy of each image of a hybrid block: of all, of its ortho-images, of single ones."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from amers.app.errors import InputError
from amers.app.usecases.image_production import ProductionImages, _read
from amers.app.usecases.model_choice import metres_by_image, stated_metres
from amers.services.formats.images.raster import write_raster
from tests.services.chip_bases import north_up, write_geotiff
from tests.services.simulated import ring_of_geometries

OF_ALL_M, OF_ORTHOS_M, OF_ONE_M = 8.0, 3.0, 2.0


@pytest.fixture
def images(tmp_path: Path) -> tuple[Path, ...]:
    """Two images with RPCs, and two on a map."""
    for name, geometry in zip(("raw_a", "raw_b"), ring_of_geometries(2), strict=True):
        write_raster(tmp_path / f"{name}.tif", np.ones(geometry.plan.shape, np.uint8), geometry.rpc)
    for name in ("map_a", "map_b"):
        grid = north_up("EPSG:32631", (7e5, 4.83e6), 10.0, 50)
        write_geotiff(tmp_path / f"{name}.tif", grid, np.ones((50, 50), np.uint8))
    return tuple(tmp_path / f"{name}.tif" for name in ("raw_a", "raw_b", "map_a", "map_b"))


def test_a_hybrid_block_has_a_sigma_for_each_kind_and_for_single_images(
    images: tuple[Path, ...],
) -> None:
    sigma_m, sigmas_m = stated_metres("--sigma-m", ["8", "raw_b.tif=2", "map_b=2"], images)
    given = ProductionImages(images, sigma_m=sigma_m, ortho_sigma_m=OF_ORTHOS_M, sigmas_m=sigmas_m)
    with ExitStack() as stack:
        scenes, _ = _read(given, stack, lambda share, message: None)
        found_m = [scene.sigma_m for scene in scenes]
    assert found_m == [OF_ALL_M, OF_ONE_M, OF_ORTHOS_M, OF_ONE_M]


def test_one_value_alone_is_that_of_all_other_images(images: tuple[Path, ...]) -> None:
    found = metres_by_image("--sigma-m", ["raw_a=2", "8"], images)
    assert list(found.values()) == [OF_ONE_M, OF_ALL_M, OF_ALL_M, OF_ALL_M]
    assert metres_by_image("--sigma-m", [], images) == {}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["8", "9"], "--sigma-m: 8 and 9 found, one value of all images expected"),
        (["far"], "--sigma-m: 'far' found, metres above 0 expected"),
        (["raw_a=0"], "--sigma-m: '0' found, metres above 0 expected"),
        (["other.tif=3"], "belongs to 0 of 4 images"),
        (["raw_a=3", "raw_a.tif=4"], "given twice for raw_a.tif"),
    ],
)
def test_what_is_no_sigma_is_refused(images: tuple[Path, ...], values: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        metres_by_image("--sigma-m", values, images)
