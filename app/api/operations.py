"""For those who keep the service running: metrics, and the record of changes."""

from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.encoders import jsonable_encoder
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from app.api.deps import Admin, DatabaseDep, MetricsReader, SettingsDep
from app.usecases import operations
from app.usecases.operations import InstallationFigures

router = APIRouter(tags=["operations"])


@router.get("/metrics", response_class=Response)
def metrics(
    request: Request, database: DatabaseDep, settings: SettingsDep, caller: MetricsReader
) -> Response:
    """Figures for Prometheus: requests of this process, jobs, queue, blocks, points, disk."""
    with database.reading() as connection:
        figures = operations.installation_figures(connection, settings.data_folder)
    now = CollectorRegistry()
    now.register(_Figures(figures))
    text = generate_latest(request.app.state.metrics.registry) + generate_latest(now)
    return Response(text, media_type=CONTENT_TYPE_PLAIN_0_0_4)


@router.get("/audit")
def audit(
    request: Request,
    database: DatabaseDep,
    caller: Admin,
    limit: Annotated[int, Query(ge=1, le=operations.MOST_CHANGES)] = 100,
    before: Annotated[
        int | None, Query(le=2**63 - 1, description="Changes with smaller ids only.")
    ] = None,
    kind: Annotated[str | None, Query(description="token, block, scene or job.")] = None,
    subject: Annotated[str | None, Query(description="Id of one of them.", max_length=300)] = None,
) -> dict[str, Any]:
    """Every change of a token, a block, a scene or a job, the newest first; it only grows."""
    with database.reading() as connection:
        found = operations.list_changes(connection, limit, before=before, kind=kind, subject=subject)
    links = [{"rel": "self", "href": str(request.url), "type": "application/json"}]
    if len(found) == limit:
        following = str(request.url.include_query_params(before=found[-1].id))
        links.append({"rel": "next", "href": following, "type": "application/json"})
    return {"changes": jsonable_encoder(found), "links": links}


class _Figures(Collector):
    def __init__(self, figures: InstallationFigures) -> None:
        self._figures = figures

    def collect(self) -> Iterator[GaugeMetricFamily]:
        store = self._figures.store
        jobs = GaugeMetricFamily("amers_jobs", "Jobs by process and state.", labels=("kind", "state"))
        for (kind, state), number in store.jobs.items():
            jobs.add_metric((kind, state), number)
        yield jobs
        blocks = GaugeMetricFamily("amers_blocks", "Blocks by state.", labels=("state",))
        for state, number in store.blocks.items():
            blocks.add_metric((state,), number)
        yield blocks
        for name, text, value in (
            ("amers_queue_length", "Entries of the queue that no worker has taken.", store.queue),
            (
                "amers_oldest_waiting_job_seconds",
                "Age of the oldest job that waits.",
                store.oldest_waiting_s,
            ),
            ("amers_points_published", "Points that are served.", store.points),
            ("amers_database_bytes", "Size of the database.", store.database_bytes),
            (
                "amers_disk_free_bytes",
                "Free on the disk of the data folder.",
                self._figures.disk_free_bytes,
            ),
            (
                "amers_disk_total_bytes",
                "Size of the disk of the data folder.",
                self._figures.disk_total_bytes,
            ),
        ):
            yield GaugeMetricFamily(name, text, value=value)
