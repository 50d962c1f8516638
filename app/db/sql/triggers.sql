-- Triggers of the store; they come after the tables.

-- The audit: columns whose changes are recorded. A progress or a lease is none of them.
create trigger audit_only_grows before update or truncate on audit
    for each statement execute function refuse_change();
create trigger audit_removal after delete on audit referencing old table as removed
    for each statement execute function record_audit_removal();
create trigger token_changes after insert or update or delete on token
    for each row execute function record_change(
        'name', 'scopes', 'subject', 'expires_at', 'revoked_at', 'storage_quota_bytes', 'job_quota');
create trigger block_changes after insert or update or delete on block
    for each row execute function record_change(
        'number', 'state', 'priority', 'checksum', 'n_points', 'n_views');
create trigger scene_changes after insert or update or delete on scene
    for each row execute function record_change('name', 'state', 'owner', 'sha256');
create trigger job_changes after insert or update or delete on job
    for each row execute function record_change(
        'kind', 'state', 'owner', 'inputs', 'error', 'results_removed_at');
create trigger point_changes after update of suspended_at on point
    for each row execute function record_change('suspended_at', 'suspended_because');
create trigger reference_image_changes after insert or update or delete on reference_image
    for each row execute function record_change(
        'name', 'image', 'dem', 'vertical', 'geoid', 'sigma_m', 'sigma_up_m');

-- Density cells and the messages of jobs follow the rows they come from.
create trigger keep_density after insert or delete or update of state on block
    for each row execute function keep_density();
create trigger job_messages after insert or update of message, attempt on job
    for each row execute function keep_job_message();
