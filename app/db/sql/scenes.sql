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
            'on_the_earth', l.report->'on_the_earth')
        from registration l where l.scene_id = s.id
        order by l.created_at desc limit 1) as accuracy
from scene s left join lateral (
    select r.job_id, r.files
    from registration r join job j on j.id = r.job_id
    where r.scene_id = s.id and j.results_removed_at is null
    order by r.created_at desc limit 1) r on true
where s.id = any(:scene_ids)
