"""Where the work under way comes from: which request, which job, which caller.

Every line of the log and every row of the audit says it. An origin belongs to one request or one attempt
at a job; code on its way fills in what it finds out, the caller for instance.
"""

import os
import pwd
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from uuid import UUID


def _who_runs_this() -> str:
    try:
        return f"{pwd.getpwuid(os.geteuid()).pw_name} on the command line"
    except KeyError:
        return f"user {os.geteuid()} on the command line"


@dataclass
class Origin:
    """Who and what is behind a change.

    Attributes:
        actor: id of the caller's token; None for commands and workers.
        actor_name: for people.
        request_id: as the reply's `X-Request-ID` says it.
        job_id: the job under way.
    """

    actor: UUID | None = None
    actor_name: str = field(default_factory=_who_runs_this)
    request_id: str | None = None
    job_id: UUID | None = None


_COMMAND = Origin()
_current: ContextVar[Origin] = ContextVar("origin", default=_COMMAND)


def current() -> Origin:
    """The origin of the work under way; that of a command when nobody has said otherwise."""
    return _current.get()


@contextmanager
def working_for(origin: Origin) -> Iterator[Origin]:
    """Work that comes from somewhere else, threads started on the way included."""
    token = _current.set(origin)
    try:
        yield origin
    finally:
        _current.reset(token)
