"""Several blocks over one place: which of two points is served, and which block comes first.

`point.superseded_by` names the point of a better block that stands for the same place; null: the point
is served as soon as its block is published. It is kept right by each publication and withdrawal.
"""

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for statement in (
        "alter table block add column priority int not null default 0",
        "alter table block add column n_superseded bigint not null default 0",
        "alter table point add column superseded_by bigint",
        "create index point_superseded on point (id) where superseded_by is not null",
        "create index point_superseded_by on point (superseded_by) where superseded_by is not null",
    ):
        op.execute(statement)


def downgrade() -> None:
    op.execute("alter table point drop column superseded_by")
    op.execute("alter table block drop column priority, drop column n_superseded")
