"""Operation of the service: metrics, status and the audit trail."""

from collections.abc import Iterator
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from amers.app.api.deps import Admin, DatabaseDep, MetricsReader, SettingsDep
from amers.app.api.models.administration import ChangeRecord, ChangeRecords, InstallationStatus
from amers.app.api.models.base import Link
from amers.app.api.negotiation import JSON
from amers.app.api.routes import CallerRoute
from amers.app.usecases import operations
from amers.app.usecases.operations import InstallationFigures

router = APIRouter(tags=["operations"], route_class=CallerRoute)


@router.get("/metrics", response_class=Response)
def metrics(
    *, request: Request, database: DatabaseDep, settings: SettingsDep, caller: MetricsReader
) -> Response:
    """Return metrics for Prometheus: requests of this process, jobs, queue, blocks, points, disk."""
    with database.reading() as connection:
        figures = operations.installation_figures(connection, settings.data_folder)
    registry = CollectorRegistry()
    registry.register(_InstallationCollector(figures))
    text = generate_latest(request.app.state.metrics.registry) + generate_latest(registry)
    return Response(text, media_type=CONTENT_TYPE_PLAIN_0_0_4)


@router.get("/status")
def status(*, database: DatabaseDep, settings: SettingsDep, caller: Admin) -> InstallationStatus:
    """Return what waits in the queue, who works, and what the installation takes of its disk."""
    with database.reading() as connection:
        figures = operations.installation_figures(connection, settings.data_folder)
    store = figures.store
    return InstallationStatus(
        workers=figures.workers,
        jobs_waiting=store.jobs_in("accepted"),
        jobs_running=store.jobs_in("running"),
        oldest_waiting_s=store.oldest_waiting_s,
        points_served=store.points,
        chip_bytes=store.chip_bytes,
        database_bytes=store.database_bytes,
        disk_free_bytes=figures.disk_free_bytes,
        disk_total_bytes=figures.disk_total_bytes,
        damaged_files=store.damaged_files,
    )


@router.get("/audit")
def audit(
    *,
    request: Request,
    database: DatabaseDep,
    caller: Admin,
    limit: Annotated[
        int, Query(ge=1, le=operations.MOST_CHANGES, description="Number of changes on a page.")
    ] = 100,
    before: Annotated[
        int | None, Query(le=2**63 - 1, description="Only changes with smaller ids.")
    ] = None,
    kind: Annotated[str | None, Query(description="Only changes of this kind of thing.")] = None,
    subject: Annotated[
        str | None, Query(max_length=300, description="Only changes of the thing with this id.")
    ] = None,
    actor: Annotated[
        str | None,
        Query(max_length=300, description="Only changes by who has this name, such as that of a token."),
    ] = None,
) -> ChangeRecords:
    """List the changes of tokens, blocks, scenes, jobs, points and references, newest first."""
    with database.reading() as connection:
        changes = operations.list_changes(
            connection, limit, before=before, kind=kind, subject=subject, actor=actor
        )
    links = [Link(rel="self", href=str(request.url), type=JSON)]
    if len(changes) == limit:
        following = str(request.url.include_query_params(before=changes[-1].id))
        links.append(Link(rel="next", href=following, type=JSON))
    records = [ChangeRecord.model_validate(change) for change in changes]
    return ChangeRecords(changes=records, links=links)


class _InstallationCollector(Collector):
    """The figures of an installation as Prometheus gauges."""

    def __init__(self, figures: InstallationFigures) -> None:
        self._figures = figures

    def collect(self) -> Iterator[GaugeMetricFamily]:
        store = self._figures.store
        jobs = GaugeMetricFamily("amers_jobs", "Jobs by process and state.", labels=("kind", "state"))
        for (kind, state), number in store.jobs.items():
            jobs.add_metric((kind, state), number)
        yield jobs
        registrations = GaugeMetricFamily(
            "amers_registration_jobs",
            "Registration jobs by verdict on their result.",
            labels=("verdict",),
        )
        for verdict, number in store.registrations.items():
            registrations.add_metric((verdict,), number)
        yield registrations
        blocks = GaugeMetricFamily("amers_blocks", "Blocks by state.", labels=("state",))
        for state, number in store.blocks.items():
            blocks.add_metric((state,), number)
        yield blocks
        for name, text, value in (
            ("amers_queue_length", "Jobs that wait for a worker.", store.queue),
            (
                "amers_oldest_waiting_job_seconds",
                "Age of the oldest job that waits, seconds.",
                store.oldest_waiting_s,
            ),
            ("amers_points_published", "Points that are served.", store.points),
            ("amers_chip_bytes", "Size of the files of chips of all blocks, bytes.", store.chip_bytes),
            ("amers_workers", "Workers that are alive.", self._figures.workers),
            (
                "amers_damaged_files",
                "Stored files found damaged or missing, and not repaired since.",
                store.damaged_files,
            ),
            ("amers_database_bytes", "Size of the database, bytes.", store.database_bytes),
            (
                "amers_disk_free_bytes",
                "Free bytes on the disk of the data folder.",
                self._figures.disk_free_bytes,
            ),
            (
                "amers_disk_total_bytes",
                "Size of the disk of the data folder, bytes.",
                self._figures.disk_total_bytes,
            ),
        ):
            yield GaugeMetricFamily(name, text, value=value)
