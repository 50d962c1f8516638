"""The files of scenes that can be had: image, models, results of the last registration."""

from dataclasses import dataclass
from uuid import UUID

from psycopg.rows import class_row

from app.db.engine import Connection


@dataclass(frozen=True)
class SceneFiles:
    """What there is of a scene.

    Attributes:
        image: name of the file; None once it was removed, or when it is not ours to give.
        models: names of the files beside it.
        job_id: that registered the scene last and whose files are still there.
        results: names of these files.
    """

    scene_id: UUID
    image: str | None
    models: list[str]
    job_id: UUID | None
    results: list[str]


def read_scene_files(connection: Connection, scene_ids: list[UUID]) -> dict[UUID, SceneFiles]:
    """The files of some scenes."""
    with connection.cursor(row_factory=class_row(SceneFiles)) as cursor:
        rows = cursor.execute(
            """select s.id as scene_id,
                   case when s.state = 'uploaded' and s.file_key is not null
                        then s.file_name end as image,
                   case when s.state = 'removed' then '{}'::text[]
                        else array(select jsonb_object_keys(s.models) order by 1) end as models,
                   r.job_id,
                   array(select jsonb_object_keys(r.files) order by 1) as results
               from scene s left join lateral (
                   select r.job_id, r.files
                   from registration r join job j on j.id = r.job_id
                   where r.scene_id = s.id and j.results_removed_at is null
                   order by r.created_at desc limit 1) r on true
               where s.id = any(%s)""",
            [scene_ids],
        )
        return {row.scene_id: row for row in rows}
