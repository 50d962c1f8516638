"""Renew a block: new views and points from scenes registered on it, as a version to publish.

Positions, covariances and frame stay those of the block. Points that later scenes no longer find are
left out and named; where points are short, two scenes or more give new ones. Nothing changes for
readers before an administrator publishes the version.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.db import blocks, renewal
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection, Database
from amers.app.db.points import points_of_block
from amers.app.errors import ComputationError, Conflict, InputError
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.lifecycle import Ingested
from amers.app.usecases.blocks.renewing_scenes import GoodScene, SceneOnBlock, register_on_block
from amers.app.usecases.damage import open_chips
from amers.services.formats.block.document import BlockMetadata, Provenance
from amers.services.formats.block.document_json import parse_block_json
from amers.services.formats.block.writer import write_block
from amers.services.production.new_points import (
    NewPoints,
    overlapping_scenes,
    points_where_short,
    short_ground,
    shown_twice,
)
from amers.services.production.renewed_views import (
    RenewedViews,
    SeeingScene,
    with_new_points,
    with_new_views,
)
from amers.services.quality.vanished import Searches, VanishedPoints, vanished_points
from amers.services.types import ChipSource, ControlPoints, IntArray, Progress, no_progress, part_of

RENEWAL = "renewal"
"""Member of the options in the provenance of a renewed block."""
USUAL_POINTS_PER_KM2 = 0.5
"""Density of a block that specifies none: one point for two square kilometres."""


@dataclass(frozen=True)
class Base:
    """A published block that is to be renewed.

    Attributes:
        block: the published version.
        version: of the renewed block.
        metadata: of the published version.
        points: those that are not suspended, with the keys of their chip files in the storage.
        suspended: ids of the suspended points, which are left out.
        typology: of the points.
    """

    block: Block
    version: str
    metadata: BlockMetadata
    points: ControlPoints
    suspended: IntArray
    typology: tuple[str | None, ...]


def read_base(connection: Connection, reference: str, version: str = "") -> Base:
    """Read a published block with all its points.

    Args:
        connection: of a snapshot.
        reference: number, ID or ID@VERSION of the block.
        version: version of the renewed block; by default the next whole number.

    Raises:
        NotFound: there is no such block, or it is not published.
        Conflict: the block has a version of this name.
        InputError: no version is given, and the published one is no number.
    """
    block = lifecycle.find_published(connection, reference)
    metadata = parse_block_json(blocks.find_document(connection, block.number)).metadata
    stored = points_of_block(connection, block.number).points
    suspended = renewal.find_suspended(connection, block.number)
    points = stored.take(np.flatnonzero(~np.isin(stored.id, suspended)))
    return Base(
        block=block,
        version=next_version(connection, block, version),
        metadata=metadata,
        points=replace(points, surface=blocks.find_surface_heights(connection, points.id)),
        suspended=suspended,
        typology=tuple(blocks.find_typology(connection, points.id)),
    )


def next_version(connection: Connection, block: Block, version: str) -> str:
    """The version of a renewed block: the one given, or the next whole number.

    Raises:
        Conflict: the block has a version of this name.
        InputError: none is given, and the published one is no number.
    """
    existing = [one.version for one in blocks.find_blocks(connection, block.id)]
    if version in existing:
        raise Conflict(f"block {block.id}@{version} is already in the store; give another version")
    if version:
        return version
    if not block.version.isdecimal():
        raise InputError(
            f"version: that of block {block.id}@{block.version} is no whole number that another "
            "one follows; name the version of the renewed block (--version)"
        )
    return str(1 + max(int(one) for one in existing if one.isdecimal()))


def renew_block(
    database: Database,
    storage: Storage,
    base: Base,
    scenes: Sequence[GoodScene],
    folder: Path,
    *,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write the renewed version of a block into a folder; returns what is new, as its document says.

    No transaction is open while scenes are registered and chips are written.

    Args:
        database, storage: of the installation.
        base: the block.
        scenes: registered on it with the verdict "good".
        folder: of the new version; must not exist.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a scene cannot be used, or adds nothing; the message names it.
        ComputationError: a scene cannot be registered on all points of the block.
    """
    chips = open_chips(database, storage)
    with ExitStack() as stack:
        stack.callback(chips.close)
        seen = register_on_block(base.points, chips, scenes, stack, part_of(progress, 0.0, 0.5))
        progress(0.5, "looking for vanished points")
        with database.reading() as connection:
            stored = renewal.find_searches(
                connection, base.block.id, [one.registration for one in scenes]
            )
        vanished = vanished_points(
            base.points.lon_lat_h, _all_searches(stored.of_points(base.points.lon_lat_h), seen)
        )
        kept = np.setdiff1d(np.arange(len(base.points)), vanished.point)
        if len(kept) == 0:
            raise InputError(
                f"block {base.block.id}: all {len(base.points)} points have vanished; withdraw the block"
            )
        renewed = _with_views(base, chips, kept, seen)
        new, note = _new_points(base, kept, seen, part_of(progress, 0.5, 0.3))
        document = _document(base, seen, renewed, vanished)
        document |= {"new_points": sum(len(one.points) for one in new), "new_points_note": note}
        metadata = _metadata(base, seen, document)
        for one in new:
            renewed = with_new_points(renewed, one)
            metadata = replace(metadata, frame=renewed.points.frames[0])
        typology = [base.typology[row] for row in kept] + [None] * document["new_points"]
        write_block(
            folder,
            metadata,
            renewed.points,
            renewed.chips,
            {},
            typology=typology,
            progress=part_of(progress, 0.8, 0.2),
        )
    return document


def stage_renewal(
    connection: Connection,
    storage: Storage,
    base: Base,
    folder: Path,
    progress: Progress = no_progress,
) -> Ingested:
    """Load the renewed version of a block, staged, with the priority of the published one.

    Raises:
        Conflict: another version of the block was published meanwhile, or it was withdrawn.
    """
    present = [one for one in blocks.find_blocks(connection, base.block.id) if one.state == "published"]
    if [one.number for one in present] != [base.block.number]:
        raise Conflict(
            f"block {base.block.id}@{base.block.version} is no longer published: renew the version that "
            "is"
        )
    return lifecycle.ingest_block(connection, storage, folder, progress, present[0].priority)


def _all_searches(stored: Searches, seen: Sequence[SceneOnBlock]) -> Searches:
    """The searches of the store, and those of all points by the scenes of the renewal."""
    first = len(stored.days)
    number = [np.full(len(one.searched), first + i) for i, one in enumerate(seen)]
    days = [np.datetime64(one.taken_at.date(), "D") for one in seen]
    return Searches(
        scene=np.concatenate([stored.scene, *number]).astype(np.int64),
        point=np.concatenate([stored.point, *(one.searched for one in seen)]),
        found=np.concatenate([stored.found, *(one.found for one in seen)]),
        days=np.concatenate([stored.days, np.array(days, dtype="datetime64[D]")]),
    )


def _with_views(
    base: Base, chips: ChipSource, kept: IntArray, seen: Sequence[SceneOnBlock]
) -> RenewedViews:
    """The kept points with their new views; every scene must give some."""
    found = [np.intersect1d(kept, one.searched[one.found]) for one in seen]
    scenes = [
        SeeingScene(one.scene, np.searchsorted(kept, rows))
        for one, rows in zip(seen, found, strict=True)
    ]
    renewed = with_new_views(base.points.take(kept), chips, scenes)
    for one, gained in zip(seen, renewed.gained, strict=True):
        if len(gained) == 0:
            sampling = ", ".join(f"{gsd_m:g}" for gsd_m in np.unique(base.points.views.gsd_m))
            raise InputError(
                f"{one.name}: gives no point a view, because its pixels are too coarse for chips of "
                f"{sampling} m or it shows none of them whole; leave it out"
            )
    return renewed


def _new_points(
    base: Base, kept: IntArray, seen: Sequence[SceneOnBlock], progress: Progress
) -> tuple[list[NewPoints], str]:
    """New points where the kept ones are fewer than specified; and how many places, or why none."""
    specification, points = base.metadata.specification, base.points.take(kept)
    per_km2 = specification.points_per_km2 or USUAL_POINTS_PER_KM2
    ground = short_ground(points, base.metadata.extent, per_km2)
    scenes = [one.scene for one in seen]
    n_short = shown_twice(ground, scenes)
    squares = f"of the squares of {ground.spacing_m:,.0f} m without a point"
    if n_short == 0:
        return [], f"none {squares} is shown by two scenes"
    new, problems = [], []
    groups = overlapping_scenes(scenes)
    for number, group in enumerate(groups):
        part = part_of(progress, number / len(groups), 1.0 / len(groups))
        try:
            new.append(points_where_short(group, points, ground, specification.min_views, part))
        except ComputationError as error:
            names = ", ".join(scene.acquisition.image_id for scene in group)
            problems.append(f"; {names} give no point: {error}")
    return new, f"{n_short} {squares} are shown by two scenes{''.join(problems)}"


def _document(
    base: Base, seen: Sequence[SceneOnBlock], renewed: RenewedViews, vanished: VanishedPoints
) -> dict[str, Any]:
    """What is renewed, as JSON values."""
    points = base.points
    return {
        "renews": f"{base.block.id}@{base.block.version}",
        "scenes": [
            {
                "name": one.name,
                "image": one.scene.acquisition.image_id,
                "taken_at": one.taken_at.isoformat(),
                "registration": str(one.registration),
                "points_seen": int(one.found.sum()),
                "points_with_new_views": len(gained),
            }
            for one, gained in zip(seen, renewed.gained, strict=True)
        ],
        "new_views": int(len(renewed.points.views.gsd_m) - _views_of(points, renewed.points)),
        "points_with_new_views": len(np.unique(np.concatenate(renewed.gained))),
        "suspended_points_left_out": base.suspended.tolist(),
        "proposed_withdrawals": [
            {
                "point": int(points.id[row]),
                "lon_lat_h": points.lon_lat_h[row].tolist(),
                "scenes_that_missed_it": int(vanished.missed[i]),
                "last_found": None if np.isnat(day) else str(day),
                "probability_if_still_there": float(f"{vanished.probability[i]:.2g}"),
            }
            for i, (row, day) in enumerate(zip(vanished.point, vanished.last_found, strict=True))
        ],
    }


def _views_of(points: ControlPoints, kept: ControlPoints) -> int:
    """The number of views that the kept points have among all points."""
    return int(np.diff(points.views.start)[np.isin(points.id, kept.id)].sum())


def _metadata(base: Base, seen: Sequence[SceneOnBlock], document: dict[str, Any]) -> BlockMetadata:
    """The description of the renewed version: that of the block, with the origin of what is new."""
    images = (one.scene.acquisition.image_id for one in seen)
    return replace(
        base.metadata,
        version=base.version,
        created=datetime.now(UTC),
        provenance=Provenance(
            "amers", installed_version("amers"), (document["renews"], *images), {RENEWAL: document}
        ),
    )
