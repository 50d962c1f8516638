"""The index of the places of points, built anew: of small stores it could lack points.

A publication that updated points while it looked for others could damage the index at the moment at
which it outgrew its first page, at some three hundred points (`amers.app.db.superseding`). Searches by
place then miss points that the table has. It locks the points for the time of the build: a second for
two hundred thousand points.
"""

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute("reindex index point_geom")


def downgrade() -> None:
    pass
