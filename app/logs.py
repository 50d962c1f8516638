"""The log: one line an event on standard error, for people (key=value) or for programs (JSON).

Every line carries the request, the job and the caller it belongs to, as far as they are known.
"""

import json
import logging
import time
from typing import Any, Literal

from app import request_context
from app.config import Settings

Format = Literal["text", "json"]

_ALWAYS = {*vars(logging.makeLogRecord({})), "message", "asctime", "taskName", "color_message"}
QUIET = ("httpx", "httpcore", "alembic", "procrastinate", "numba", "PIL", "botocore", "uvicorn.access")
"""Libraries whose ordinary business is not the operator's."""


def configure(settings: Settings) -> None:
    """Make this process log as the settings say; called once, by each command that runs long."""
    handler = logging.StreamHandler()
    handler.setFormatter(Lines(settings.log_format))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.log_level.upper())
    for name in QUIET:
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("uvicorn.error").addFilter(_not_told_already)


def _not_told_already(record: logging.LogRecord) -> bool:
    """The server tells the trace of a request that broke off once more, without saying which it was."""
    return not record.getMessage().startswith("Exception in ASGI application")


class Lines(logging.Formatter):
    """Records as lines; whatever a record carries in `extra` becomes a field."""

    def __init__(self, form: Format) -> None:
        super().__init__()
        self._form = form

    def format(self, record: logging.LogRecord) -> str:
        """One line; a trace is a field of a JSON line and follows a plain one."""
        fields = _fields(record)
        trace = self.formatException(record.exc_info) if record.exc_info else None
        if self._form == "json":
            if trace:
                fields["trace"] = trace
            return json.dumps(fields, default=str, ensure_ascii=False)
        time_, level, logger, message = (str(fields.pop(name)) for name in _FIRST)
        rest = "".join(f" {name}={_plain(value)}" for name, value in fields.items())
        line = f"{time_} {level} {logger}: {_one_line(message)}{rest}"
        return f"{line}\n{trace}" if trace else line


_FIRST = ("time", "level", "logger", "message")


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
    where = request_context.current()
    known = {"request_id": where.request_id, "job_id": where.job_id, "actor": where.actor}
    return {
        "time": f"{moment}.{int(record.msecs):03d}Z",
        "level": record.levelname,
        "logger": record.name,
        "message": record.getMessage(),
        **{name: str(value) for name, value in known.items() if value is not None},
        **{name: value for name, value in vars(record).items() if name not in _ALWAYS},
    }


def _plain(value: object) -> str:
    """A value without blanks as it is, others quoted, so that a line can be split again."""
    text = str(value)
    return text if text and text.isprintable() and not set(text) & set(' "=') else json.dumps(text)


def _one_line(message: str) -> str:
    """What somebody sent must not look like a line of ours."""
    return message.replace("\r", "\\r").replace("\n", "\\n")
