"""The state of a job, as a client sees it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Self

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
Progress = Callable[[float, str], None]
"""Receives the completed fraction (0 to 1) and a short description of the current step."""


def no_progress(fraction: float, message: str) -> None:
    """Ignore the progress."""


@dataclass(frozen=True)
class Job:
    """The state of a job at one moment.

    Attributes:
        id: its identifier.
        process: the process that it executes.
        status: `accepted` while it waits in the queue.
        progress: completed part, percent.
        message: the current step, or how the job ended.
        verdict: of a registration that has ended: good, usable, failed or not registered; else None.
        error: kind of the error that ended it, by its name in Amers; "" without an error.
        document: the whole reply, statusInfo of OGC API - Processes.
    """

    id: str
    process: str
    status: JobStatus
    progress: int
    message: str
    verdict: str | None
    error: str
    document: dict[str, Any] = field(repr=False)

    @classmethod
    def of(cls, document: dict[str, Any]) -> Self:
        """The state that a reply of the service describes."""
        return cls(
            id=document["jobID"],
            process=document["processID"],
            status=document["status"],
            progress=document["progress"],
            message=document["message"] or "",
            verdict=document.get("amers:verdict"),
            error=(document.get("error") or {}).get("error", ""),
            document=document,
        )

    @property
    def has_ended(self) -> bool:
        """Whether the job neither waits nor runs."""
        return self.status not in ("accepted", "running")
