"""Who may call and how much, and a record of every change that nobody can rewrite.

The record is kept by triggers: whatever changes a token, a block, a scene or a job, through whichever
door, leaves a row in the same transaction. Who it was is said by settings of the transaction
(`app/db/engine.py`).
"""

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

TOKEN = (
    """alter table token
        alter column secret_hash drop not null,
        add column subject text unique,
        add column upload_quota_bytes bigint check (upload_quota_bytes >= 0),
        add column job_quota int check (job_quota >= 0),
        drop constraint token_scopes_check,
        add constraint token_scopes_check
            check (scopes <@ array['read', 'register', 'monitor', 'admin'] and scopes <> '{}'),
        add constraint token_has_secret_or_subject check ((secret_hash is null) <> (subject is null))""",
)

AUDIT = """
create table audit (
    id bigint generated always as identity primary key,
    at timestamptz not null default clock_timestamp(),
    actor uuid,
    actor_name text not null,
    request_id text,
    job_id uuid,
    kind text not null,
    subject text not null,
    action text not null check (action in ('created', 'changed', 'deleted')),
    before jsonb,
    after jsonb
)
"""

RECORD_CHANGE = """
create function record_change() returns trigger language plpgsql as $$
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
end $$
"""

REFUSE_CHANGE = """
create function refuse_change() returns trigger language plpgsql as $$
begin
    raise exception 'table % only grows', tg_table_name using errcode = 'insufficient_privilege';
end $$
"""

RECORDED = {
    "token": (
        "name",
        "scopes",
        "subject",
        "expires_at",
        "revoked_at",
        "upload_quota_bytes",
        "job_quota",
    ),
    "block": ("number", "state", "priority", "checksum", "n_points", "n_views"),
    "scene": ("name", "state", "owner", "sha256"),
    "job": ("kind", "state", "owner", "inputs", "error"),
}
"""Table to columns whose change is recorded; a progress or a lease is none."""


def upgrade() -> None:
    for statement in (
        *TOKEN,
        AUDIT,
        "create index audit_subject on audit (kind, subject, id)",
        RECORD_CHANGE,
        REFUSE_CHANGE,
        """create trigger audit_only_grows before update or delete or truncate on audit
           for each statement execute function refuse_change()""",
    ):
        op.execute(statement)
    for table, columns in RECORDED.items():
        names = ", ".join(f"'{column}'" for column in columns)
        op.execute(
            f"""create trigger {table}_changes after insert or update or delete on {table}
                for each row execute function record_change({names})"""
        )


def downgrade() -> None:
    for table in RECORDED:
        op.execute(f"drop trigger {table}_changes on {table}")
    for statement in (
        "drop table audit",
        "drop function record_change",
        "drop function refuse_change",
        "delete from token where secret_hash is null or 'monitor' = any(scopes)",
        """alter table token
            drop constraint token_has_secret_or_subject,
            drop constraint token_scopes_check,
            add constraint token_scopes_check
                check (scopes <@ array['read', 'register', 'admin'] and scopes <> '{}'),
            drop column subject, drop column upload_quota_bytes, drop column job_quota,
            alter column secret_hash set not null""",
    ):
        op.execute(statement)
