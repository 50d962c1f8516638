"""The origin of the work under way: the request, the job and the caller it belongs to.

Every line of the log and every row of the audit contains it. An origin belongs to one request or one
attempt at a job; later steps add what they learn, such as the caller.
"""

import os
import pwd
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from uuid import UUID


def _command_line_user() -> str:
    try:
        return f"{pwd.getpwuid(os.geteuid()).pw_name} on the command line"
    except KeyError:
        return f"user {os.geteuid()} on the command line"


@dataclass
class Origin:
    """The origin of a change.

    Attributes:
        actor: id of the caller's token; None for commands and workers.
        actor_name: for people.
        request_id: the `X-Request-ID` of the reply.
        job_id: of the job under way.
    """

    actor: UUID | None = None
    actor_name: str = field(default_factory=_command_line_user)
    request_id: str | None = None
    job_id: UUID | None = None


_COMMAND = Origin()
_current: ContextVar[Origin] = ContextVar("origin", default=_COMMAND)


def current() -> Origin:
    """The origin of the work under way; by default a command of the user of this process."""
    return _current.get()


@contextmanager
def working_for(origin: Origin) -> Iterator[Origin]:
    """Set the origin of the work in the context, including that of threads started there."""
    token = _current.set(origin)
    try:
        yield origin
    finally:
        _current.reset(token)
