"""Models of blocks and of their quality."""

from datetime import datetime
from typing import Literal
from uuid import UUID

from amers.app.api.models.base import Count, Reply, StatedAccuracy
from amers.app.db.schema import BlockState


class BlockRecord(Reply):
    """One version of a block.

    `n_unserved` counts the points that are not served: another block has better ones, or they are
    suspended.
    """

    number: int
    id: str
    version: str
    title: str
    state: BlockState
    priority: int
    n_points: Count
    n_unserved: Count
    n_views: Count
    checksum: str
    created_at: datetime
    state_changed_at: datetime


class ChangedBlock(Reply):
    """A block after a change."""

    block: BlockRecord


class PublishedBlock(ChangedBlock):
    """A block after its publication, and the version that it superseded; null if there was none."""

    superseded: BlockRecord | None


class DeletedBlock(ChangedBlock):
    """A block as it was before it was deleted.

    `n_files` of its files of chips are in the trash; `n_shared_files` stay, because other blocks have
    them too.
    """

    n_files: int
    n_shared_files: int


class UploadedBlock(Reply):
    """An uploaded archive of a block; `POST /blocks` names it by this id."""

    upload: UUID


class Distribution(Reply):
    """Five figures of the values of one kind."""

    minimum: float
    median: float
    mean: float
    p90: float
    maximum: float


class AccuracyRecord(Reply):
    """A figure on the accuracy of a block, with the reference it was measured against."""

    kind: Literal["relative", "absolute"]
    name: str
    value: float
    count: Count
    against: str


class BlockQuality(Reply):
    """The quality of a block, from its points and views.

    `relative_to_control_points` and `on_the_earth` are of its median point, without and with the frame
    of the block.

    `share_reaching_half` and `share_reaching_quarter` are the parts of the area where the density
    reaches 1 point for 2 km2 and for 4 km2. Each of `cells` is a list of west and south in degrees,
    area in km2, number of points.
    """

    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    points: Count
    area_km2: float
    points_per_km2: float
    share_reaching_half: float
    share_reaching_quarter: float
    images_per_point: Distribution
    views_per_point: Distribution
    sigma_horizontal_m: Distribution
    sigma_up_m: Distribution
    cells: list[tuple[float, float, float, float]]
    accuracy: list[AccuracyRecord]
