-- Sums over registrations. Rows change in the order of their keys, so that of two registrations of one
-- place one waits and none deadlocks.

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
from tried order by point_id
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
from tried order by point_id, view
on conflict (point_id, view) do update set attempts = h.attempts + 1,
    successes = h.successes + excluded.successes, expected = h.expected + excluded.expected
