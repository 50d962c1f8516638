"""Points of several block folders are those of each, with their own chips and frames."""

from pathlib import Path

import numpy as np

from services.formats.block.check import check_block
from services.formats.block.reader import FolderChips
from services.formats.block.several import SeveralChips, points_of_several
from services.types import ControlPoints, Frame, point_chips
from tests.app.flat_world import make_flat_world

FRAMES = (Frame.from_sigmas(1.0, 2.0), Frame.from_sigmas(3.0, 4.0))
COLUMNS = ("lon_lat_h", "covariance_m2", "saliency", "health")


def test_points_keep_their_ground_their_views_and_their_chips(tmp_path: Path) -> None:
    folders = [
        make_flat_world(tmp_path / str(seed), size=500, points=seed, seed=seed, frame=frame).block
        for seed, frame in zip((4, 7), FRAMES, strict=True)
    ]
    parts: list[ControlPoints] = [check_block(folder).points for folder in folders]
    sources = tuple(FolderChips(folder) for folder in folders)
    chips = SeveralChips(sources)
    points = points_of_several(parts)
    assert len(points) == len(np.unique(points.id)) == 11
    assert points.id[:4].tolist() == parts[0].id.tolist()
    of_part = [points.take(np.arange(4)), points.take(np.arange(4, 11))]
    for part, own, source, frame in zip(of_part, parts, sources, FRAMES, strict=True):
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(part, name), getattr(own, name))
        np.testing.assert_array_equal(part.views.gsd_m, own.views.gsd_m)
        np.testing.assert_array_equal(part.views.incidence_deg, own.views.incidence_deg)
        taken = [part.views.images[row] for row in part.views.image]
        assert taken == [own.views.images[row] for row in own.views.image]
        for row in range(len(own)):
            expected = point_chips(own, source, row)
            np.testing.assert_array_equal(point_chips(part, chips, row), expected)
            stated = points.frames[part.block[row]].covariance_m2
            np.testing.assert_array_equal(stated, frame.covariance_m2)
    for source in sources:
        source.close()
