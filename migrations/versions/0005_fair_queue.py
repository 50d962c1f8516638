"""The fair queue: priorities, delays, the turns of owners; queue entries no longer name a job.

It locks the tables of jobs and of the queue for as long as two indexes on the open jobs take: about a
second with a million jobs.
"""

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

UPGRADE = """
alter table job add column priority smallint default 0 not null,
    add column not_before timestamptz,
    add constraint job_priority_check check (priority between -100 and 100);
create index job_waiting on job (owner, priority desc, created_at, id) where state = 'accepted';
create index job_running on job (owner) where state = 'running';
create table job_turn (
    owner uuid,
    claimed_at timestamptz not null,
    constraint job_turn_owner_key unique nulls not distinct (owner),
    constraint job_turn_owner_fkey foreign key (owner) references token (id) on delete cascade
);
insert into job_turn select owner, max(claimed_at) from job where claimed_at is not null group by owner;
update job set not_before = entry.scheduled_at from procrastinate_jobs entry
    where state = 'accepted' and entry.status = 'todo' and entry.args ->> 'job_id' = job.id::text;
update procrastinate_jobs set args = '{}' where task_name = 'amers:job';
"""
# The sweep of an earlier Amers puts all waiting jobs into the queue again.
DOWNGRADE = """
delete from procrastinate_jobs where task_name = 'amers:job';
drop table job_turn;
drop index job_waiting, job_running;
alter table job drop constraint job_priority_check, drop column priority, drop column not_before;
"""


def upgrade() -> None:
    _run(UPGRADE)


def downgrade() -> None:
    _run(DOWNGRADE)


def _run(script: str) -> None:
    """Run several statements as they are: percent signs and colons have no meaning to the driver."""
    connection = op.get_bind().connection.driver_connection
    assert connection is not None
    connection.execute(script)
