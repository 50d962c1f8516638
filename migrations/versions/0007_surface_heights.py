"""The surface at the centres of points: its height and its standard deviation, null where unknown.

It locks the table of points for some milliseconds, however many points it has: columns without a default
are added to the catalogue only. There are no checks of values, which would read all points under this
lock; the check of a block before its ingestion has them.
"""

from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute(
        "alter table point add column surface_height_m double precision, add column surface_sigma_m real"
    )


def downgrade() -> None:
    op.execute("alter table point drop column surface_height_m, drop column surface_sigma_m")
