"""Indexes with which a block is deleted without reading the points of all others.

It locks the points against changes for the time of the builds: seconds for a million of them. The index
of the files of chips takes some seven bytes a point, that of the blocks next to nothing.
"""

from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

UPGRADE = """
create index point_block on point using brin (block_number);
create index point_chip_file on point (chip_file)
"""


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    op.execute("drop index point_block, point_chip_file")
