"""What a job said on its way, and results that are removed after a while.

Whatever changes the message of a job, through whichever door, leaves a row: an attempt that begins, a
step of the work, a worker that was lost, an end.
"""

from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

KEEP_MESSAGE = """
create function keep_job_message() returns trigger language plpgsql as $$
begin
    if tg_op = 'INSERT' or (old.message, old.attempt) is distinct from (new.message, new.attempt) then
        insert into job_message (job_id, attempt, progress, message)
        values (new.id, new.attempt, new.progress, new.message);
    end if;
    return null;
end $$
"""

RECORDED = "'kind', 'state', 'owner', 'inputs', 'error'"


def upgrade() -> None:
    for statement in (
        KEEP_MESSAGE,
        """create trigger job_messages after insert or update of message, attempt on job
           for each row execute function keep_job_message()""",
        "drop trigger job_changes on job",
        f"""create trigger job_changes after insert or update or delete on job
            for each row execute function record_change({RECORDED}, 'results_removed_at')""",
        """create index job_results on job (finished_at)
           where state = 'successful' and results_removed_at is null""",
    ):
        op.execute(statement)


def downgrade() -> None:
    for statement in (
        "drop index job_results",
        "drop trigger job_changes on job",
        f"""create trigger job_changes after insert or update or delete on job
            for each row execute function record_change({RECORDED})""",
        "drop trigger job_messages on job",
        "drop function keep_job_message",
    ):
        op.execute(statement)
