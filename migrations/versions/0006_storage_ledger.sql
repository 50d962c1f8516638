alter table token rename column upload_quota_bytes to storage_quota_bytes;
alter table token rename constraint token_upload_quota_bytes_check to token_storage_quota_bytes_check;
drop trigger token_changes on token;
create trigger token_changes after insert or update or delete on token
    for each row execute function record_change(
        'name', 'scopes', 'subject', 'expires_at', 'revoked_at', 'storage_quota_bytes', 'job_quota');

alter table scene add column side_file_bytes bigint not null default 0;
update scene set side_file_bytes =
    (select coalesce(sum((value->>'size_bytes')::bigint), 0) from jsonb_each(models));
create index scene_usage on scene (owner) include (size_bytes, side_file_bytes)
    where state <> 'removed';

create index upload_usage on upload (owner) include (size_bytes, finished_at)
    where finished_at is null or file_key is not null;

-- The sizes of earlier results are not in the database: null, until the sweep has measured the files. The
-- uptime of existing rows is the present one, so that a retention by default removes nothing at once.
alter table job add column results_bytes bigint default 0;
alter table job add column created_at_uptime_s double precision not null default uptime_s();
update job set results_bytes = null
    where state = 'successful' and results ? 'files' and results_removed_at is null;
create index job_usage on job (owner) include (results_bytes) where results_bytes > 0;

alter table registration drop constraint registration_job_id_fkey,
    add constraint registration_job_id_fkey foreign key (job_id) references job (id) on delete set null;

-- Add a row to `audit`. Settings of the transaction name who makes the change and why
-- (`app/db/engine.py`); the change of a job is a change of the owner of the job.
create function add_audit_row(kind text, subject text, action text, before jsonb, after jsonb)
returns void language sql as $$
    with origin as (
        select nullif(current_setting('amers.actor', true), '')::uuid as actor,
            nullif(current_setting('amers.job_id', true), '')::uuid as job_id
    )
    insert into audit (actor, actor_name, request_id, job_id, kind, subject, action, before, after)
    select coalesce(actor, (select owner from job where id = origin.job_id)),
        coalesce(
            nullif(current_setting('amers.actor_name', true), ''), 'database role ' || session_user),
        nullif(current_setting('amers.request_id', true), ''),
        job_id, kind, subject, action, before, after
    from origin
$$;

-- Trigger with column names as arguments: a row in `audit` when one of these columns changes.
create or replace function record_change() returns trigger language plpgsql as $$
declare
    full_before jsonb;
    full_after jsonb;
    before jsonb;
    after jsonb;
    named jsonb;
begin
    if tg_op <> 'INSERT' then full_before := to_jsonb(old); end if;
    if tg_op <> 'DELETE' then full_after := to_jsonb(new); end if;
    select jsonb_object_agg(key, value) into before
        from jsonb_each(full_before) where key = any(tg_argv);
    select jsonb_object_agg(key, value) into after
        from jsonb_each(full_after) where key = any(tg_argv);
    if before is not distinct from after then return null; end if;
    named := coalesce(full_after, full_before);
    perform add_audit_row(
        tg_table_name,
        case tg_table_name when 'block' then (named->>'id') || '@' || (named->>'version')
                           else named->>'id' end,
        case tg_op when 'INSERT' then 'created' when 'UPDATE' then 'changed' else 'deleted' end,
        before, after);
    return null;
end $$;

-- Trigger of `audit` after a deletion: accept the oldest rows without a gap, if the service has run for 30
-- days since the last of them, and leave a row that says which rows were removed. Refuse anything else.
create function record_audit_removal() returns trigger language plpgsql as $$
declare
    gone record;
begin
    select count(*) as rows, min(id) as first, max(id) as last, min(at) as since, max(at) as until,
        max(at_uptime_s) as until_uptime_s into gone from removed;
    if gone.rows = 0 then return null; end if;
    if gone.until > now() - interval '30 days' or gone.until_uptime_s > uptime_s() - 30 * 86400
        or exists (select from audit where id < gone.last)
    then
        raise exception 'table audit only grows: only its oldest rows can be removed, 30 days after them'
            using errcode = 'insufficient_privilege';
    end if;
    perform add_audit_row('audit', gone.first || '-' || gone.last, 'deleted',
        jsonb_build_object('rows', gone.rows, 'since', gone.since, 'until', gone.until), null);
    return null;
end $$;

-- A job may be removed later, so that its changes name the owner themselves.
alter table audit add column at_uptime_s double precision not null default uptime_s();
drop trigger audit_only_grows on audit;
update audit set actor = job.owner from job where job.id = audit.job_id and actor is null;
create trigger audit_only_grows before update or truncate on audit
    for each statement execute function refuse_change();
create trigger audit_removal after delete on audit referencing old table as removed
    for each statement execute function record_audit_removal();
