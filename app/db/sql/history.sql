-- Sums over registrations. Rows change in the order of their keys, so that of two registrations of one
-- place one waits and none deadlocks. A point whose block was deleted since it was tried has no sums.

-- name: count_points
-- Add the outcome of each point that a registration tried to the sums of the point.
with tried as (
    select point_id, active, matched, residual_east_m, residual_north_m,
        |/ (residual_line_px ^ 2 + residual_sample_px ^ 2) as residual_px
    from measure
    where registration_id = cast(:registration_id as uuid)
        and reason <> all(cast(:not_attributable as text[]))
)
insert into point_history as h (point_id, attempts, successes, expected, matched,
    sum_residual_px, sum_east_m, sum_north_m, last_attempt, last_success)
select point_id, 1, active::int, (select avg(active::int) from tried), matched::int,
    coalesce(residual_px, 0), coalesce(residual_east_m, 0), coalesce(residual_north_m, 0),
    now(), case when active then now() end
from tried where exists (select from point where id = point_id) order by point_id
on conflict (point_id) do update set attempts = h.attempts + 1,
    successes = h.successes + excluded.successes, expected = h.expected + excluded.expected,
    matched = h.matched + excluded.matched,
    sum_residual_px = h.sum_residual_px + excluded.sum_residual_px,
    sum_east_m = h.sum_east_m + excluded.sum_east_m,
    sum_north_m = h.sum_north_m + excluded.sum_north_m,
    last_attempt = excluded.last_attempt,
    last_success = coalesce(excluded.last_success, h.last_success)

-- name: count_views
-- Add the outcome of each view of an active point that a registration tried to the sums of the view.
with tried as (
    select v.point_id, v.view, v.agreed
    from view_measure v join measure m using (registration_id, point_id)
    where v.registration_id = cast(:registration_id as uuid) and m.active
        and v.reason <> all(cast(:not_attributable as text[]))
)
insert into view_history as h (point_id, view, attempts, successes, expected)
select point_id, view, 1, agreed::int, (select avg(agreed::int) from tried)
from tried where exists (select from point where id = point_id) order by point_id, view
on conflict (point_id, view) do update set attempts = h.attempts + 1,
    successes = h.successes + excluded.successes, expected = h.expected + excluded.expected

-- name: searches
-- The searches of points of a block in the counted registrations with the verdict "good", but for some:
-- points that kept their places through versions of the block are told by them. A scene of unknown date
-- counts as taken when it was registered.
select m.registration_id, coalesce(
        cast(r.report #>> '{scene,acquisition,acquired_at}' as timestamptz), r.created_at) as taken_at,
    st_x(p.geom) as lon, st_y(p.geom) as lat, st_z(p.geom) as h, m.active
from registration r join measure m on m.registration_id = r.id join point p on p.id = m.point_id
    join block b on b.number = p.block_number
where r.counted and r.verdict = 'good' and b.id = :block_id
    and r.block_versions @> cast(:has_block as jsonb)
    and r.id <> all(cast(:left_out as uuid[]))
    and m.reason <> all(cast(:not_attributable as text[]))
