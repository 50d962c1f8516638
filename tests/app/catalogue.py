"""What the catalogue of a database says of its objects, but for those of extensions."""

import psycopg

_NOT_OF_EXTENSIONS = "not exists (select from pg_depend d where d.objid = {oid} and d.deptype = 'e')"
_QUERIES = {
    "columns": """
        select c.relname || '.' || a.attname,
            concat_ws(' ', format_type(a.atttypid, a.atttypmod), a.attnotnull, a.attidentity,
                a.attgenerated, pg_get_expr(d.adbin, d.adrelid), col_description(c.oid, a.attnum),
                a.attacl)
        from pg_class c join pg_attribute a on a.attrelid = c.oid
        left join pg_attrdef d on d.adrelid = c.oid and d.adnum = a.attnum
        where c.relnamespace = 'public'::regnamespace and c.relkind in ('r', 'v', 'm', 'p')
            and a.attnum > 0 and not a.attisdropped and {of_class}""",
    "relations": """
        select concat(c.relkind, ' ', c.relname),
            concat_ws(' ', c.relpersistence, c.reloptions, c.relacl, obj_description(c.oid),
                case when c.relkind in ('v', 'm') then pg_get_viewdef(c.oid) end)
        from pg_class c
        where c.relnamespace = 'public'::regnamespace and c.relkind in ('r', 'v', 'm', 'p', 'S')
            and {of_class}""",
    "indexes": """
        select c.relname, pg_get_indexdef(c.oid)
        from pg_class c
        where c.relnamespace = 'public'::regnamespace and c.relkind = 'i' and {of_class}""",
    "constraints": """
        select concat(r.relname, '.', n.conname), pg_get_constraintdef(n.oid)
        from pg_constraint n left join pg_class r on r.oid = n.conrelid
        where n.connamespace = 'public'::regnamespace and {of_constraint}""",
    "triggers": """
        select r.relname || '.' || t.tgname, concat_ws(' ', pg_get_triggerdef(t.oid), t.tgenabled)
        from pg_trigger t join pg_class r on r.oid = t.tgrelid
        where r.relnamespace = 'public'::regnamespace and not t.tgisinternal""",
    "functions": """
        select p.proname || '(' || pg_get_function_identity_arguments(p.oid) || ')',
            concat_ws(' ', pg_get_functiondef(p.oid), p.proacl)
        from pg_proc p
        where p.pronamespace = 'public'::regnamespace and p.prokind in ('f', 'p') and {of_function}""",
    "types": """
        select t.typname, concat_ws(' ', t.typtype,
            (select string_agg(e.enumlabel, ',' order by e.enumsortorder) from pg_enum e
             where e.enumtypid = t.oid))
        from pg_type t
        where t.typnamespace = 'public'::regnamespace and t.typtype in ('e', 'd') and {of_type}""",
    "statistics": """
        select s.stxname, pg_get_statisticsobjdef(s.oid) from pg_statistic_ext s
        where s.stxnamespace = 'public'::regnamespace""",
}


def catalogue(dsn: str) -> dict[str, str]:
    """The definition of each object of the schema, by its kind and name."""
    parts = {
        f"of_{kind}": _NOT_OF_EXTENSIONS.format(oid=f"{alias}.oid")
        for kind, alias in (
            ("class", "c"),
            ("constraint", "n"),
            ("function", "p"),
            ("type", "t"),
        )
    }
    found = {}
    with psycopg.connect(dsn) as connection:
        for kind, query in _QUERIES.items():
            for name, definition in connection.execute(query.format(**parts)):
                found[f"{kind}: {name}"] = definition
    return found


def row_counts(dsn: str) -> dict[str, int]:
    """The number of rows of each table of the schema, but for those of extensions."""
    tables = [name.removeprefix("relations: r ") for name in catalogue(dsn) if ": r " in name]
    with psycopg.connect(dsn) as connection:
        return {
            name: connection.execute(f'select count(*) from "{name}"').fetchone()[0]  # type: ignore[index]
            for name in tables
        }
