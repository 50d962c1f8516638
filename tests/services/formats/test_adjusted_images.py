"""The adjusted images of a block are read as they were written, each with its own displacement."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import FormatError
from amers.services.formats.adjusted_images import read_adjusted_images, write_adjusted_images
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Frame


def known() -> KnownImages:
    """Four images, of which the second and the last have displacements of different shapes."""
    rng = np.random.default_rng(4)
    names, shapes = ("a", "b", "c", "d"), {1: (3, 2), 3: (2, 5)}
    grids = [
        DisplacementGrid(
            *(np.cumsum(rng.uniform(1.0, 2.0, n)) for n in shapes[k]),
            *rng.normal(size=(2, *shapes[k], 2)),
            rng.normal(size=k),
        )
        if k in shapes
        else None
        for k in range(4)
    ]
    return KnownImages(
        names,
        (("roll", "pitch", "yaw"), ("line", "sample"), ("roll",), ("line", "sample", "drift")),
        rng.normal(size=(4, 3)),
        rng.normal(size=(12, 12)),
        Frame(np.diag([1.0, 2.0, 3.0])),
        rng.normal(size=(4, 7, 3)),
        rng.normal(size=(4, 7, 2)),
        tuple(grids),
    )


def test_images_read_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "images.npz"
    write_adjusted_images(path, "block_7", known())
    block, read = read_adjusted_images(path)
    assert block == "block_7"
    assert (read.names, read.parameters) == (known().names, known().parameters)
    for name in ("values", "relative", "ground", "line_sample"):
        np.testing.assert_array_equal(getattr(read, name), getattr(known(), name))
    np.testing.assert_array_equal(read.frame.covariance_m2, known().frame.covariance_m2)
    for found, expected in zip(read.displacements, known().displacements, strict=True):
        assert (found is None) == (expected is None)
        for name in vars(expected) if expected else ():
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"relative": np.eye(11)}, "do not fit each other"),
        ({"line_sample": np.zeros((4, 6, 2))}, "do not fit each other"),
        ({"ground": np.zeros((3, 7, 3))}, "do not fit each other"),
        ({"values": np.full((4, 3), np.nan)}, "unknown numbers found"),
        ({"relative": np.full((12, 12), np.inf)}, "unknown numbers found"),
        ({"frame": Frame(np.full((3, 3), np.nan))}, "unknown numbers found"),
    ],
)
def test_arrays_that_do_not_fit_and_unknown_numbers_are_refused(
    tmp_path: Path, changes: dict[str, object], says: str
) -> None:
    path = tmp_path / "images.npz"
    write_adjusted_images(path, "block", replace(known(), **changes))
    with pytest.raises(FormatError, match=says):
        read_adjusted_images(path)


def test_displacements_are_as_large_as_their_nodes_are_many(tmp_path: Path) -> None:
    grid = known().displacements[3]
    assert grid is not None
    path = tmp_path / "images.npz"
    for wrong in (replace(grid, line=grid.line[:1]), replace(grid, variance_px2=grid.variance_px2[:1])):
        write_adjusted_images(path, "block", replace(known(), displacements=(None, None, None, wrong)))
        with pytest.raises(FormatError, match="the displacement of image 4 does not fit its nodes"):
            read_adjusted_images(path)
