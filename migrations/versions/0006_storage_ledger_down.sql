drop trigger audit_removal on audit;
drop trigger audit_only_grows on audit;
create trigger audit_only_grows before update or delete or truncate on audit
    for each statement execute function refuse_change();
alter table audit drop column at_uptime_s;

-- Trigger with column names as arguments: a row in `audit` when one of these columns changes.
-- Settings of the transaction name who changes it and why (`app/db/engine.py`).
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
    insert into audit
        (actor, actor_name, request_id, job_id, kind, subject, action, before, after)
    values (
        nullif(current_setting('amers.actor', true), '')::uuid,
        coalesce(
            nullif(current_setting('amers.actor_name', true), ''), 'database role ' || session_user),
        nullif(current_setting('amers.request_id', true), ''),
        nullif(current_setting('amers.job_id', true), '')::uuid,
        tg_table_name,
        case tg_table_name when 'block' then (named->>'id') || '@' || (named->>'version')
                           else named->>'id' end,
        case tg_op when 'INSERT' then 'created' when 'UPDATE' then 'changed' else 'deleted' end,
        before, after);
    return null;
end $$;

drop function record_audit_removal, add_audit_row;
alter table registration drop constraint registration_job_id_fkey,
    add constraint registration_job_id_fkey foreign key (job_id) references job (id);
drop index job_usage, upload_usage, scene_usage;
alter table job drop column results_bytes, drop column created_at_uptime_s;
alter table scene drop column side_file_bytes;
drop trigger token_changes on token;
alter table token rename constraint token_storage_quota_bytes_check to token_upload_quota_bytes_check;
alter table token rename column storage_quota_bytes to upload_quota_bytes;
create trigger token_changes after insert or update or delete on token
    for each row execute function record_change(
        'name', 'scopes', 'subject', 'expires_at', 'revoked_at', 'upload_quota_bytes', 'job_quota');
