"""A renewal fills a hole of a block from scenes that were registered on it; the other points stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.db import engine
from app.db.engine import Database
from app.db.points import points_of_block
from app.storage import Storage
from app.usecases.blocks import lifecycle
from app.usecases.blocks.renewal import find_renewal, read_base, renew_block, stage_renewal
from app.usecases.blocks.renewing_scenes import scene_of_image
from app.usecases.registration.control_sources import points_of_store
from app.usecases.registration.register import (
    ControlSources,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from services.formats.block.writer import write_block
from services.formats.images.raster import write_raster
from services.geodesy import east_north_up
from services.registration.options import RegistrationOptions
from services.types import point_chips
from tests.factories import metadata
from tests.services.block_with_hole import HOLE_M, PER_KM2, SIGMA_M, older, simulated

pytestmark = pytest.mark.long


def publish_block_with_hole(dsn: str, storage: Storage, folder: Path) -> None:
    _, block, outline = older()
    stated = metadata("holed", "1", gsds_m=tuple(np.unique(block.points.views.gsd_m).tolist()))
    specification = replace(stated.specification, points_per_km2=PER_KM2)
    write_block(
        folder,
        replace(stated, extent=outline, specification=specification, frame=block.points.frames[0]),
        block.points,
        lambda row: point_chips(block.points, block.chips, row),
        {},
    )
    with engine.connect(dsn) as connection:
        ingested = lifecycle.ingest_block(connection, storage, folder).block
        lifecycle.publish_block(connection, str(ingested.number))


def test_a_renewal_fills_the_hole_of_a_block(
    dsn: str, database: Database, storage: Storage, tmp_path: Path
) -> None:
    publish_block_with_hole(dsn, storage, tmp_path / "holed")
    images = []
    for number, view in enumerate(simulated(seed=21, error_m=SIGMA_M)):
        images.append(tmp_path / f"later_{number}.tif")
        write_raster(images[-1], view.pixels, view.geometry.delivered)
        made = run_registration(
            SceneFiles(images[-1], sigma_m=SIGMA_M),
            ControlSources(points_of_store(database, storage)),
            tmp_path / f"out_{number}",
            options=RegistrationOptions(max_points=0),
        )
        assert made.report.verdict == "good"
        with database.transaction() as connection:
            record_registration(connection, made, image_key(images[-1]))

    with database.snapshot() as snapshot:
        base = read_base(snapshot, "holed")
        scenes = [scene_of_image(snapshot, base.block, image) for image in images]
    document = renew_block(database, storage, base, scenes, tmp_path / "renewed")
    with database.transaction() as connection:
        staged = stage_renewal(connection, storage, base, tmp_path / "renewed").block
        assert find_renewal(connection, staged) == document
        old = points_of_block(connection, base.block.number).points
        new = points_of_block(connection, staged.number).points
    assert document["proposed_withdrawals"] == []
    assert document["new_points"] == len(new) - len(old) >= 6
    assert "shown by two scenes" in document["new_points_note"]

    kept = {place.tobytes() for place in old.lon_lat_h}
    is_new = np.array([place.tobytes() not in kept for place in new.lon_lat_h])
    assert is_new.sum() == document["new_points"]
    enu = east_north_up(new.lon_lat_h[is_new], np.array([*base.metadata.extent.mean(axis=0), 0.0]))
    assert (np.abs(enu[:, :2]) < HOLE_M).all(axis=1).sum() >= 6
    of_view = np.repeat(np.arange(len(new)), np.diff(new.views.start))
    names = np.array([image.image_id for image in new.views.images])[new.views.image]
    assert set(names[is_new[of_view]].tolist()) == {image.stem for image in images}
