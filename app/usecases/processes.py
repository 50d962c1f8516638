"""What a process is: work that users request and workers do, in the sense of OGC API - Processes."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any
from uuid import UUID

from pydantic import TypeAdapter, ValidationError

from amers.app.auth import Scope
from amers.app.config import Settings
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs.jobs import Job
from amers.app.db.tokens import Token
from amers.app.errors import AmersError, InputError
from amers.app.json_values import unusable_value
from amers.app.storage import Storage
from amers.services.docstrings import attribute_descriptions
from amers.services.statements import Statements
from amers.services.types import Progress

Commit = Callable[[Connection], dict[str, Any]]
"""Writes the outcome of a job in the transaction that ends the job, and returns the job's results."""


class WorkFailed(Exception):
    """A process could not do its work, and made results that explain why.

    Attributes:
        error: that ends the job.
        results: of the job, with the storage keys of its files as `files`.
    """

    def __init__(self, error: AmersError, results: dict[str, Any]) -> None:
        super().__init__(str(error))
        self.error = error
        self.results = results


@dataclass(frozen=True)
class Work:
    """A job and all that its process needs to do it.

    Attributes:
        job: the job, with the number of this attempt.
        inputs: of the process's own input type.
        database, storage, settings: of the installation.
        progress: receives the fraction done and a message; call it often, it also raises `LostJob` when
            the job was dismissed.
    """

    job: Job
    inputs: Any
    database: Database
    storage: Storage
    settings: Settings
    progress: Progress

    @property
    def attempt_folder(self) -> str:
        """Key prefix of the files of this attempt in the storage; no other attempt uses it."""
        return f"{results_folder(self.job.id)}/{self.job.attempt}"


def results_folder(job_id: UUID) -> str:
    """Key prefix of the files of all attempts at a job in the storage."""
    return f"results/{job_id}"


def work_folder(job_id: UUID) -> str:
    """Name of the folder in which the attempts at a job on one machine keep what the next can use."""
    return f"work-{job_id}"


def result_name(key: str) -> str:
    """The name of a file among the results of its job, by its key in the storage."""
    return key.split("/", 3)[3]


STATEMENTS_VALUE: dict[str, Any] = {
    "type": "array",
    "items": {"type": "object"},
    "title": "What the files state, and whether it was used, assumed or not used",
}
"""Schema of the output `statements`, which `stated_document` makes."""


def stated_document(statements: Statements) -> list[dict[str, Any]]:
    """What files state, as the output `statements` of a job."""
    return [asdict(statement) for statement in statements]


@dataclass(frozen=True)
class Process:
    """A process.

    Attributes:
        id, title, description: for users.
        scope: that a token needs to execute the process.
        inputs: a frozen dataclass with the inputs.
        outputs: the output files, name to description.
        values: the other outputs, name to the JSON Schema of the value.
        check: refuses unusable inputs of a caller before the job is created.
        run: does the work outside of any transaction and returns the function that writes the outcome.
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

    def check_outputs(self, requested: Mapping[str, str]) -> None:
        """Refuse names of outputs that the process does not have.

        Raises:
            InputError: the message lists these names and the existing ones.
        """
        existing = (*self.values, *self.outputs)
        unknown = [name for name in requested if name not in existing]
        if unknown:
            raise InputError(
                f"outputs of {self.id}: {', '.join(unknown)[:200]}: no such output; "
                f"expected one of {', '.join(existing)}"
            )

    def parse_inputs(self, document: dict[str, Any]) -> Any:
        """The inputs of a request as an object of the process's input type.

        Raises:
            InputError: a value is missing, has the wrong type, or is unknown; the message names it.
        """
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        try:
            _refuse_unusable(document, self.id)
            inputs = adapter.validate_python(document)
        except ValidationError as error:
            problems = "; ".join(
                f"{'.'.join(str(part) for part in item['loc'])}: {item['msg']}"
                for item in error.errors()
            )
            raise InputError(f"inputs of {self.id}: {problems}") from None
        # A text such as "NaN" becomes a number only now.
        _refuse_unusable(asdict(inputs), self.id)
        unknown = _unknown_fields(document, adapter.dump_python(inputs, mode="json"))
        if unknown:
            raise InputError(f"inputs of {self.id}: {', '.join(unknown)}: no such input")
        return inputs

    def format_inputs(self, inputs: Any) -> dict[str, Any]:
        """The inputs as JSON values, with all defaults filled in."""
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        document: dict[str, Any] = adapter.dump_python(inputs, mode="json")
        return document

    def input_descriptions(self) -> dict[str, str]:
        """The description of every input, by name."""
        return attribute_descriptions(self.inputs)

    def input_schema(self) -> dict[str, Any]:
        """JSON Schema of the inputs."""
        adapter: TypeAdapter[Any] = TypeAdapter(self.inputs)
        return adapter.json_schema()


def _refuse_unusable(inputs: dict[str, Any], process_id: str) -> None:
    """Refuse inputs that no job can store: infinite numbers, NaN, and texts that are not Unicode."""
    problem = unusable_value(inputs, "inputs")
    if problem is not None:
        raise InputError(f"{problem} ({process_id})")


def _unknown_fields(document: dict[str, Any], understood: dict[str, Any], path: str = "") -> list[str]:
    """Paths of the fields that the input type does not have: a misspelt option must not be ignored."""
    unknown = []
    for name, value in document.items():
        if name not in understood:
            unknown.append(path + name)
        elif isinstance(value, dict) and isinstance(understood[name], dict):
            unknown += _unknown_fields(value, understood[name], f"{path}{name}.")
    return unknown
