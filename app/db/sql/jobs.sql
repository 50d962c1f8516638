-- Statements on jobs and on the tables of the queue.

-- name: forgotten_jobs
-- Accepted jobs that the queue does not have any more.
select id from job
where state = 'accepted' and updated_at < clock_timestamp() - make_interval(secs => :after_s)
    and not exists (select from procrastinate_jobs
                    where task_name = :task and status = 'todo' and args ->> 'job_id' = job.id::text)
for update skip locked

-- name: prune_silent_workers
select worker_id from procrastinate_prune_stalled_workers_v1(:silent_s)

-- name: delete_dead_entries
-- Entries whose worker was pruned.
delete from procrastinate_jobs where task_name = :task and status = 'doing' and worker_id is null

-- name: expected_end
-- When a job may end: the median durations of past jobs, shared by the workers that give signs of life.
-- A job that has not started waits for the rest of those that run and for all that are older.
with typical as (
    select kind, (select percentile_cont(0.5) within group (order by seconds)
                  from (select extract(epoch from finished_at - claimed_at) as seconds
                        from job p where p.kind = k.kind and state = 'successful'
                        order by finished_at desc limit :past) past) as seconds
    from (select distinct kind from job where state in ('accepted', 'running')) k
), own as (
    select seconds from typical where kind = :kind
), before as (
    select sum(case state when 'accepted' then t.seconds
        else greatest(t.seconds - extract(epoch from clock_timestamp() - claimed_at), 0)
        end) as seconds
    from job join typical t using (kind)
    where state = 'running' or (state = 'accepted' and (created_at, id) < (:created_at, :id))
), workers as (
    select greatest(count(*), 1) as n from procrastinate_workers
    where last_heartbeat > clock_timestamp() - make_interval(secs => :beating_s)
)
select case when cast(:claimed_at as timestamptz) is null
    then clock_timestamp() + make_interval(
        secs => coalesce(before.seconds, 0) / workers.n + own.seconds)
    else greatest(clock_timestamp(),
                  cast(:claimed_at as timestamptz) + make_interval(secs => own.seconds))
    end
from own, before, workers where own.seconds is not null
