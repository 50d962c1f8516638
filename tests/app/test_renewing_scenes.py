"""What a scene that renews a block tells of the points of the block, and what it cannot tell."""

from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from amers.app.usecases.blocks.renewing_scenes import GoodScene, register_on_block
from amers.app.usecases.registration.register import SceneFiles
from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import FolderChips
from amers.services.types import no_progress
from tests.app.flat_world import SIGMA_M
from tests.app.renewal_world import HALF_PX, make_years, write_scene
from tests.geotiffs import write_geotiff

pytestmark = [pytest.mark.long, pytest.mark.thorough]


def test_points_under_clouds_of_a_mask_were_not_searched_and_those_that_changed_were(
    tmp_path: Path,
) -> None:
    """A cloud is no evidence that a point has vanished; ground that no longer looks like it is."""
    years = make_years(tmp_path / "world")
    points = check_block(years.world.block).points
    inside = np.flatnonzero((np.abs(years.places - 600) < 300).all(axis=1))
    apart_px = np.abs(years.places[inside] - years.places[inside[0]]).max(axis=1)
    changed, clouded = int(inside[0]), int(inside[np.argmax(apart_px)])
    image = tmp_path / "later.tif"
    write_scene(years, image, years.world.ground, day="2025-05-05", changed=(changed,))
    shape = years.world.ground.shape
    cloud = np.zeros(shape, dtype=np.uint8)
    line, sample = years.places[clouded]
    half = HALF_PX + 20
    cloud[line - half : line + half, sample - half : sample + half] = 1
    mask = tmp_path / "mask.tif"
    write_geotiff(mask, cloud)
    files = SceneFiles(image, sigma_m=SIGMA_M, mask=mask)
    given = GoodScene("later", files, uuid4(), datetime.now(UTC))
    with ExitStack() as stack:
        chips = stack.enter_context(FolderChips(years.world.block))
        (scene,) = register_on_block(points, chips, [given], stack, no_progress)
    found = dict(zip(scene.searched.tolist(), scene.found.tolist(), strict=True))
    assert clouded not in found
    assert found[changed] is False
    assert np.mean(list(found.values())) > 0.7
    assert scene.taken_at.date().isoformat() == "2025-05-05"
    hidden = (np.abs(years.places - years.places[clouded]) < HALF_PX // 2).all(axis=1)
    assert not set(found) & set(np.flatnonzero(hidden).tolist())
