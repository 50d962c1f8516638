"""The CPU that the jobs of each owner have taken, and the sessions of browsers that were signed out.

It adds two columns to the table of turns, which has a row for each owner, and a table of sessions that
ended before their hour. It locks the table of turns for an instant; points, measures and jobs are not
touched.
"""

from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

UPGRADE = """
alter table job_turn add column cpu_s double precision not null default 0;
alter table job_turn add column cpu_at timestamptz not null default clock_timestamp();
create table ended_session (
    id uuid not null,
    ends_at timestamptz not null,
    constraint ended_session_pkey primary key (id)
)
"""

DOWNGRADE = """
drop table ended_session;
alter table job_turn drop column cpu_at;
alter table job_turn drop column cpu_s
"""


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    op.execute(DOWNGRADE)
