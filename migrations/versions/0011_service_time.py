"""Time that the service has run: what nobody goes on with is given up by it, not by a clock that jumps.

The sweep lets it go on by what the clock of the database says, a few hours at most each time; so a clock
that is put a year ahead, or back, changes the age of an upload by no more than that.
"""

from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

UP = (
    """create table service_time (
        single boolean primary key default true check (single),
        ran_s double precision not null default 0,
        read_at timestamptz not null default now()
    )""",
    "insert into service_time default values",
    """create function service_time_s() returns double precision language sql stable as
        $$ select ran_s from service_time $$""",
    "alter table upload add column idle_since_s double precision not null default service_time_s()",
    "alter table scene add column begun_at_s double precision not null default service_time_s()",
    # Jobs of one transaction are told apart by when they were asked for, as in the queue.
    "alter table job alter column created_at set default clock_timestamp()",
)
DOWN = (
    "alter table job alter column created_at set default now()",
    "alter table scene drop column begun_at_s",
    "alter table upload drop column idle_since_s",
    "drop function service_time_s()",
    "drop table service_time",
)


def upgrade() -> None:
    for statement in UP:
        op.execute(statement)


def downgrade() -> None:
    for statement in DOWN:
        op.execute(statement)
