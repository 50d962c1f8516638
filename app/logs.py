"""The log on standard error: one line per event, for people (key=value) or for programs (JSON).

Every line has the request, the job and the caller it belongs to, where they are known. No line
has a control character, whatever the texts of callers and files are: escapes stand for them.
"""

import json
import logging
import time
from typing import Any, Literal

from amers.app import request_context
from amers.app.config import Settings
from amers.app.printable import printable, printable_json

Format = Literal["text", "json"]

_ALWAYS = {*vars(logging.makeLogRecord({})), "message", "asctime", "taskName", "color_message"}
QUIET = ("httpx", "httpcore", "alembic", "procrastinate", "numba", "PIL", "botocore", "uvicorn.access")
"""Libraries whose messages below warnings are not logged."""


def configure(settings: Settings) -> None:
    """Configure the log of this process by the settings; every long-running command calls it once."""
    handler = logging.StreamHandler()
    handler.setFormatter(Lines(settings.log_format))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.log_level.upper())
    for name in QUIET:
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("uvicorn.error").addFilter(_is_new)


def _is_new(record: logging.LogRecord) -> bool:
    """False for a traceback that the server repeats: our log has it already, with its request."""
    return not record.getMessage().startswith("Exception in ASGI application")


class Lines(logging.Formatter):
    """Formats records as lines; values in `extra` become fields."""

    def __init__(self, form: Format) -> None:
        super().__init__()
        self._form = form

    def format(self, record: logging.LogRecord) -> str:
        """One line; a traceback is a field of a JSON line, and follows a text line, indented."""
        fields = _fields(record)
        trace = self.formatException(record.exc_info) if record.exc_info else None
        if self._form == "json":
            if trace:
                fields["trace"] = trace
            return printable_json(json.dumps(fields, default=str, ensure_ascii=False))
        time_, level, logger, message = (str(fields.pop(name)) for name in _FIRST)
        rest = "".join(f" {name}={_quoted(value)}" for name, value in fields.items())
        line = printable(f"{time_} {level} {logger}: {_one_line(message)}{rest}")
        return f"{line}\n{_indented(trace)}" if trace else line


_FIRST = ("time", "level", "logger", "message")


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
    origin = request_context.current()
    context = {"request_id": origin.request_id, "job_id": origin.job_id, "actor": origin.actor}
    return {
        "time": f"{moment}.{int(record.msecs):03d}Z",
        "level": record.levelname,
        "logger": record.name,
        "message": record.getMessage(),
        **{name: str(value) for name, value in context.items() if value is not None},
        **{name: value for name, value in vars(record).items() if name not in _ALWAYS},
    }


def _quoted(value: object) -> str:
    """The text of a value, quoted if it has blanks, so that a program can split the line."""
    text = str(value)
    return text if text and text.isprintable() and not set(text) & set(' "=') else json.dumps(text)


def _one_line(message: str) -> str:
    """A message without line breaks: text that a caller sent must not look like a log line."""
    return message.replace("\r", "\\r").replace("\n", "\\n")


def _indented(trace: str) -> str:
    """A traceback none of whose lines looks like a line of the log: the error may quote a caller."""
    return "\n".join(f"    {printable(line)}" for line in trace.split("\n"))
