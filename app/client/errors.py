"""What can go wrong between a client and a service."""

from .job import Job

BUSY = (408, 429)
"""Statuses of refusals that are about the moment: too slow, too many."""


class ServiceError(Exception):
    """Every error of the client: what the service did with which request."""


class ServiceFailure(ServiceError):
    """The service does not answer, or not as expected; the same request may succeed later."""


class RequestRefused(ServiceError):
    """The service refuses a request, by the problem details of its reply (RFC 9457).

    Attributes:
        status: HTTP status, 400 to 499.
        error: kind of error by its name in Amers, such as `FormatError`; "" where the reply has none.
    """

    def __init__(self, message: str, status: int, error: str) -> None:
        super().__init__(message)
        self.status = status
        self.error = error


class JobFailed(ServiceError):
    """A job has failed or was dismissed; `job.error` names the kind of error.

    Attributes:
        job: its last state. `Client.download` gets the report of a failed registration.
    """

    def __init__(self, job: Job) -> None:
        super().__init__(f"job {job.id}: {job.status}: {job.message}")
        self.job = job


def is_transient(error: ServiceError) -> bool:
    """Whether the same request may succeed later: no answer, an outage, or too many requests."""
    return isinstance(error, ServiceFailure) or getattr(error, "status", None) in BUSY
