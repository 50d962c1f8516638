-- name: scene_files
-- Files of some scenes: image, models, and results of the last registration whose files are still there;
-- and the accuracy that the report of the last registration states.
select s.id as scene_id,
    case when s.state = 'uploaded' and s.file_key is not null then s.file_name end as image,
    case when s.state = 'removed' then '{}'::text[]
         else array(select jsonb_object_keys(s.models) order by 1) end as models,
    r.job_id,
    coalesce(r.files, '{}'::jsonb) as results,
    (select jsonb_build_object(
            'verdict_scope', l.report->'verdict_scope',
            'relative_to_control_points', l.report->'relative_to_control_points',
            'on_the_earth', l.report->'on_the_earth',
            'held_percent', l.report->'coverage'->'percent',
            'held_polygons', l.report->'coverage'->'polygons_lon_lat')
        from registration l where l.scene_id = s.id
        order by l.created_at desc limit 1) as accuracy
from scene s left join lateral (
    select r.job_id, r.files
    from registration r join job j on j.id = r.job_id
    where r.scene_id = s.id and j.results_removed_at is null
    order by r.created_at desc limit 1) r on true
where s.id = any(:scene_ids)

-- name: scene_registrations
-- The last registrations of some scenes, whichever way they end; dismissed ones are left out. A job is
-- not older than its scene, which bounds what is read of the jobs of an owner.
with wanted as (
    select id, owner, created_at from scene where id = any(:scene_ids)
), asked as (
    select j.id as job_id, j.kind as process, j.state, j.created_at, j.finished_at, j.results, named.scene_id
    from job j cross join lateral jsonb_array_elements_text(
        case j.kind when 'register-scene' then jsonb_build_array(j.inputs->'scene')
             else j.inputs->'scenes' end) as named(scene_id)
    where j.kind in ('register-scene', 'register-scenes') and j.state <> 'dismissed'
        and j.created_at >= (select min(created_at) from wanted)
        and (j.owner in (select owner from wanted) or j.owner = :caller)
), ranked as (
    select w.id as scene_id, a.job_id, a.process, a.state, a.created_at, a.finished_at, a.results,
        row_number() over (partition by w.id order by a.created_at desc, a.job_id) as place
    from wanted w join asked a on a.scene_id = w.id::text
)
select k.scene_id, k.job_id, k.process, k.created_at, k.finished_at,
    case when k.state in ('accepted', 'running') then 'under way'
         when r.verdict in ('good', 'usable') then 'registered' else 'failed' end as outcome,
    coalesce(r.verdict, k.results->>'verdict') as verdict,
    r.report->'relative_to_control_points' as relative_to_control_points,
    r.report->'on_the_earth' as on_the_earth
from ranked k left join registration r on r.job_id = k.job_id and r.scene_id = k.scene_id
where k.place <= :most
order by k.created_at desc, k.job_id
