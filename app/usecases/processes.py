"""What a process is: something a user can ask for that a worker does."""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter, ValidationError

from app.auth import Scope
from app.config import Settings
from app.db.engine import Connection, Database
from app.db.jobs.jobs import Job
from app.db.tokens import Token
from app.errors import InputError
from app.storage import Storage
from services.types import Progress

Commit = Callable[[Connection], dict[str, Any]]
"""Writes the outcome of a job in the transaction that ends it, and returns what `results` shall say."""


@dataclass(frozen=True)
class Work:
    """A job as the process that does it sees it.

    Attributes:
        inputs: of the process's own type.
        progress: to be called often; it also notices that the job was dismissed.
    """

    job: Job
    inputs: Any
    database: Database
    storage: Storage
    settings: Settings
    progress: Progress

    @property
    def attempt_folder(self) -> str:
        """Where the storage keeps the files of this attempt and of no other."""
        return f"results/{self.job.id}/{self.job.attempt}"


@dataclass(frozen=True)
class Process:
    """Something a user can ask for that a worker does.

    Attributes:
        id, title, description: for users.
        scope: what a token needs to ask for it.
        inputs: a frozen dataclass: what a user can say.
        outputs: files that it makes, name to description.
        values: what else it tells, name to the JSON Schema of its value.
        check: refuses inputs that cannot work, for this caller, when the job is asked for.
        run: does the work, outside of any transaction; the outcome is written by what it returns.
    """

    id: str
    title: str
    description: str
    scope: Scope
    inputs: type[Any]
    outputs: dict[str, str]
    check: Callable[[Connection, Token, Any], None]
    run: Callable[[Work], Commit]
    values: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    def check_outputs(self, asked: Mapping[str, str]) -> None:
        """Refuse outputs that it does not make.

        Raises:
            InputError: naming them.
        """
        known = (*self.values, *self.outputs)
        unknown = [name for name in asked if name not in known]
        if unknown:
            raise InputError(
                f"outputs of {self.id}: {', '.join(unknown)[:200]}: no such output; "
                f"there are {', '.join(known)}"
            )

    def parse_inputs(self, given: dict[str, Any]) -> Any:
        """Inputs of the process's own type.

        Raises:
            InputError: a value is missing, of another type, or unknown; the message names it.
        """
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        try:
            parsed = adapter.validate_python(given)
        except ValidationError as error:
            wrong = "; ".join(
                f"{'.'.join(str(part) for part in item['loc'])}: {item['msg']}"
                for item in error.errors()
            )
            raise InputError(f"inputs of {self.id}: {wrong}") from None
        unknown = _unknown_fields(given, adapter.dump_python(parsed, mode="json"))
        if unknown:
            raise InputError(f"inputs of {self.id}: {', '.join(unknown)}: no such input")
        return parsed

    def format_inputs(self, inputs: Any) -> dict[str, Any]:
        """Inputs as JSON, all defaults filled in."""
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        formatted: dict[str, Any] = adapter.dump_python(inputs, mode="json")
        return formatted

    def input_text(self, name: str) -> str:
        """What an input is, in a few words; "" when nothing is said."""
        return _texts(self.inputs.__doc__ or "").get(name, "")

    def input_schema(self) -> dict[str, Any]:
        """JSON Schema of the inputs."""
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        return adapter.json_schema()


def _texts(docstring: str) -> dict[str, str]:
    """What the docstring of a dataclass says of its attributes, by their names."""
    _, _, said = inspect.cleandoc(docstring).partition("Attributes:\n")
    entries = re.split(r"\n    (?=\S)", "\n" + said)
    pairs = [entry.split(": ", 1) for entry in entries if ": " in entry]
    return {name.strip(): " ".join(text.split()) for names, text in pairs for name in names.split(",")}


def _unknown_fields(given: dict[str, Any], known: dict[str, Any], path: str = "") -> list[str]:
    """Paths of what was given and not understood: a misspelt option must not be ignored."""
    unknown = []
    for name, value in given.items():
        if name not in known:
            unknown.append(path + name)
        elif isinstance(value, dict) and isinstance(known[name], dict):
            unknown += _unknown_fields(value, known[name], f"{path}{name}.")
    return unknown
