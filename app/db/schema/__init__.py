"""The tables of the store: every column, constraint and index, named and typed here and nowhere else.

Statements name columns through these tables, and the column list of a row comes from its table
(`app/db/rows.py`). Functions, triggers and the first rows are SQL: `app/db/sql/functions.sql`,
`triggers.sql` and `first_rows.sql`. `python -m amers.app.db.ddl` prints the whole store as one script.

The tables of the queue belong to procrastinate and are not described here.
"""

from amers.app.db.schema.access import audit, ended_session, installation, token, uptime
from amers.app.db.schema.base import clock, hours, metadata, now, uptime_s
from amers.app.db.schema.integrity import damaged_file, result_file
from amers.app.db.schema.jobs import job, job_message, job_turn, scene, upload
from amers.app.db.schema.points import block, chip_file, density_cell, image, point, view
from amers.app.db.schema.registrations import (
    measure,
    point_history,
    reference_image,
    reference_point,
    registration,
    view_history,
    view_measure,
)
from amers.app.db.states import BlockState, JobResponse, JobState, SceneState, UploadPurpose

__all__ = [
    "BlockState",
    "JobResponse",
    "JobState",
    "SceneState",
    "UploadPurpose",
    "audit",
    "block",
    "chip_file",
    "clock",
    "damaged_file",
    "density_cell",
    "ended_session",
    "hours",
    "image",
    "installation",
    "job",
    "job_message",
    "job_turn",
    "measure",
    "metadata",
    "now",
    "point",
    "point_history",
    "reference_image",
    "reference_point",
    "registration",
    "result_file",
    "scene",
    "token",
    "upload",
    "uptime",
    "uptime_s",
    "view",
    "view_history",
    "view_measure",
]
