"""The store: tables, indexes, functions, triggers and the rows that every store has.

The script beside this file was written by `python -m amers.app.db.ddl` from `app/db/schema` and
`app/db/sql`. It is a copy, because a migration must do the same thing for ever while the schema goes on
to change: later changes are revisions of their own. `tests/app/test_schema.py` compares the result of
all revisions with the schema, completely.
"""

from pathlib import Path

from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

SCRIPT = Path(__file__).with_suffix(".sql")

DROP_STORE = """
drop table
    audit, block, chip_file, density_cell, image, installation, job, job_message, measure, point,
    point_history, reference_image, reference_point, registration, scene, token, upload, uptime, view,
    view_history, view_measure;
drop function
    add_density, count_unserved_cells, keep_density, keep_job_message, record_change, refuse_change,
    uptime_s, zone_km2;
"""


def upgrade() -> None:
    _run(SCRIPT.read_text())


def downgrade() -> None:
    _run(DROP_STORE)


def _run(script: str) -> None:
    """Run several statements as they are: percent signs and colons have no meaning to the driver."""
    connection = op.get_bind().connection.driver_connection
    assert connection is not None
    connection.execute(script)
