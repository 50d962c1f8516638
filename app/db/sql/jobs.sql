-- Statements on jobs and on the tables of the queue.

-- name: next_job
-- The job to claim: of the highest priority; then of the owner with the fewest running jobs; then of the
-- owner whose last job was claimed longest ago; then the oldest. A row that is being written is passed over.
-- The first job of one owner after that of another is one step in the index, however many jobs he has.
with recursive head_of_tokens as (
    (select id, owner, priority, created_at from job
        where state = 'accepted' and owner is not null
            and (not_before is null or not_before <= statement_timestamp())
        order by owner, priority desc, created_at, id limit 1)
    union all
    select next.* from head_of_tokens last, lateral (
        select id, owner, priority, created_at from job
        where state = 'accepted' and owner > last.owner
            and (not_before is null or not_before <= statement_timestamp())
        order by owner, priority desc, created_at, id limit 1) next
), heads as (
    select * from head_of_tokens
    union all
    (select id, owner, priority, created_at from job
        where state = 'accepted' and owner is null
            and (not_before is null or not_before <= statement_timestamp())
        order by owner, priority desc, created_at, id limit 1)
), running as (
    select owner, count(*) as n from job where state = 'running' group by owner
)
select job.id
from heads join job using (id)
    left join running on running.owner is not distinct from heads.owner
    left join job_turn on job_turn.owner is not distinct from heads.owner
where coalesce(running.n, 0) < coalesce(cast(:running_limit as bigint), coalesce(running.n, 0) + 1)
order by heads.priority desc, coalesce(running.n, 0), job_turn.claimed_at nulls first,
    heads.created_at, heads.id
limit 1
for update of job skip locked

-- name: few_tickets
-- Whether fewer tickets than many may be taken now.
select count(*) < :many from (
    select 1 from procrastinate_jobs
    where task_name = :task and status = 'todo'
        and (scheduled_at is null or scheduled_at <= statement_timestamp())
    limit :many) tickets

-- name: missing_tickets
-- How many jobs may be claimed beyond the tickets that are left for them.
with owners as (
    select owner,
        count(*) filter (where state = 'running') as running,
        count(*) filter (where state = 'accepted'
            and updated_at <= statement_timestamp() - make_interval(secs => :after_s)
            and (not_before is null or not_before <= statement_timestamp())) as waiting
    from job where state in ('accepted', 'running') group by owner
)
select greatest(0, cast(coalesce(sum(least(waiting,
        greatest(coalesce(cast(:running_limit as bigint), running + waiting) - running, 0))), 0) as bigint)
    - (select count(*) from procrastinate_jobs
       where task_name = :task and status = 'todo'
           and (scheduled_at is null or scheduled_at <= statement_timestamp())))
from owners

-- name: prune_silent_workers
select worker_id from procrastinate_prune_stalled_workers_v1(:silent_s)

-- name: delete_dead_entries
-- Entries whose worker was pruned.
delete from procrastinate_jobs where task_name = :task and status = 'doing' and worker_id is null

-- name: outlook
-- The place of a waiting job in the queue, and when an open job may end: after those before it, the median
-- durations of past jobs shared by the workers that give signs of life. The order is that of `next_job`
-- when every owner has as many running jobs: one job of each owner in turn.
with waiting as (
    select job.id, kind, (-priority, row_number() over in_turn, coalesce(job_turn.claimed_at, '-infinity'),
                          created_at, job.id) as place
    from job left join job_turn on coalesce(job_turn.owner, :nobody) = coalesce(job.owner, :nobody)
    where state = 'accepted' and (select state from job where id = :id) = 'accepted'
    window in_turn as (partition by job.owner, priority order by created_at, job.id)
), before as (
    select kind from waiting where place < (select place from waiting where id = :id)
), typical as (
    select kind, (select percentile_cont(0.5) within group (order by seconds)
                  from (select extract(epoch from finished_at - claimed_at) as seconds
                        from job p where p.kind = k.kind and state = 'successful'
                        order by finished_at desc limit :past) past) as seconds
    from (select distinct kind from job where state in ('accepted', 'running')) k
), own as (
    select job.state, claimed_at, seconds
    from job left join typical using (kind) where id = :id and state in ('accepted', 'running')
), queued as (
    select coalesce(sum(seconds), 0) as seconds from before join typical using (kind)
), under_way as (
    select coalesce(sum(greatest(
        seconds - extract(epoch from clock_timestamp() - claimed_at), 0)), 0) as seconds
    from job join typical using (kind) where state = 'running'
), workers as (
    select greatest(count(*), 1) as n from procrastinate_workers
    where last_heartbeat > clock_timestamp() - make_interval(secs => :beating_s)
)
select case own.state when 'accepted' then (select count(*) + 1 from before) end as position,
    case when own.seconds is null then null
        when own.state = 'accepted' then clock_timestamp() + make_interval(
            secs => (queued.seconds + under_way.seconds) / workers.n + own.seconds)
        else greatest(clock_timestamp(), claimed_at + make_interval(secs => own.seconds))
    end as expected_end
from own, queued, under_way, workers

-- name: count_workers
-- The workers that have sent a heartbeat lately.
select count(*) from procrastinate_workers
where last_heartbeat > clock_timestamp() - make_interval(secs => :beating_s)

-- name: movement
-- Whether jobs move: the running job whose process has been silent for longest, and the job that has waited
-- for longest of those that may be claimed. The queue moves when a job is claimed or ends; the last message
-- of an ended job tells when it ended.
with running as (
    select id, owner, extract(epoch from clock_timestamp() - updated_at) as silent_s
    from job where state = 'running'
), busy as (
    select owner, count(*) as n from running group by owner
), claimable as (
    select id, extract(epoch from clock_timestamp() - greatest(updated_at, not_before)) as waited_s
    from job left join busy on busy.owner is not distinct from job.owner
    where state = 'accepted' and (not_before is null or not_before <= clock_timestamp())
        and coalesce(busy.n, 0) < coalesce(cast(:running_limit as bigint), coalesce(busy.n, 0) + 1)
), last_end as (
    select written_at from job_message join job on job.id = job_id
    where state not in ('accepted', 'running') order by job_message.id desc limit 1
), silent as (
    select id, silent_s from running order by silent_s desc limit 1
), first as (
    select id, waited_s from claimable order by waited_s desc limit 1
)
select (select count(*) from procrastinate_workers
        where last_heartbeat > clock_timestamp() - make_interval(secs => :beating_s)) as workers,
    (select count(*) from running) as running,
    (select id from silent) as silent_job,
    cast(coalesce((select silent_s from silent), 0) as float) as silent_s,
    (select count(*) from claimable) as claimable,
    (select id from first) as first_job,
    cast(coalesce((select least(waited_s, extract(epoch from clock_timestamp() - greatest(
        (select max(claimed_at) from job_turn), (select written_at from last_end)))) from first), 0)
        as float) as still_s
