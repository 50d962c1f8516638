"""An index of the registrations that count in the histories, with which the last of them are found.

It locks the table of registrations for the time of the build: a second for a million of them. Points and
measures are not touched.
"""

from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute("create index registration_last_counted on registration (created_at) where counted")


def downgrade() -> None:
    op.execute("drop index registration_last_counted")
