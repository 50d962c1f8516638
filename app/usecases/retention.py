"""Retention: what ended long ago is removed, by the settings of the installation."""

import logging

from amers.app.config import Settings
from amers.app.db import audit
from amers.app.db.engine import Database
from amers.app.db.jobs import jobs
from amers.app.request_context import Origin, working_for
from amers.app.storage import Storage
from amers.app.usecases.processes import results_folder
from amers.app.usecases.results import delete_files

DAY_S = 86_400.0

log = logging.getLogger(__name__)


def remove_what_is_old(database: Database, storage: Storage, settings: Settings) -> None:
    """Remove the old results, jobs and audit rows; a setting without days keeps them."""
    with working_for(Origin(actor_name="retention")):
        if settings.result_days is not None:
            remove_old_results(database, storage, settings.result_days)
        if settings.job_record_days is not None:
            with database.transaction() as connection:
                n_jobs = jobs.delete_old(connection, DAY_S * settings.job_record_days)
            if n_jobs:
                log.info("deleted %d jobs older than %g days", n_jobs, settings.job_record_days)
        if settings.audit_days is not None:
            with database.transaction() as connection:
                n_changes = audit.remove_old(connection, DAY_S * settings.audit_days)
            if n_changes:
                log.info("removed %d audit rows older than %g days", n_changes, settings.audit_days)


def remove_old_results(database: Database, storage: Storage, days: float) -> None:
    """Delete the files of jobs that ended this many days ago; the jobs stay."""
    with database.transaction() as connection:
        job_ids = jobs.remove_old_results(connection, DAY_S * days)
    for job_id in job_ids:
        delete_files(storage, results_folder(job_id))
        log.info("job %s: removed its results, which are older than %g days", job_id, days)
