-- name: remove_old
-- Remove the oldest changes without a gap, as soon as the oldest of all exceeds the age by a day. The age
-- counts by the clock and by the time that the service has run: a clock that jumps ahead removes nothing.
with oldest as (
    select at < clock_timestamp() - make_interval(secs => :older_than_s) - interval '1 day'
        and at_uptime_s < uptime_s() - :older_than_s - 86400 as is_due
    from audit order by id limit 1
), first_kept as (
    select min(id) as id from (
        (select id from audit
         where at >= clock_timestamp() - make_interval(secs => :older_than_s)
            or at_uptime_s >= uptime_s() - :older_than_s order by id limit 1)
        union all
        (select id from audit order by id offset :most limit 1)
    ) candidate
), removed as (
    delete from audit
    where (select is_due from oldest) and id < (select coalesce(id, 9223372036854775807) from first_kept)
    returning id
)
select count(*) from removed
