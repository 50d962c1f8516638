"""What a command ends with: a table of outcomes times commands."""

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

import pytest

from amers.app import errors
from amers.app.cli.exit_status import exit_status
from amers.app.cli.failures import failure
from amers.app.cli.main import app
from amers.app.cli.scene_registration import worst_status
from amers.app.client import errors as client_errors
from amers.services import errors as service_errors
from tests.app.recorders import Anything, Recorders
from tests.app.wiring import BESIDE, PACKAGE, commands, parameters, value_of

NO_RESULT = {
    "ComputationError",
    "NotEnoughPoints",
    "NoConsensus",
    "TurnedImage",
    "RescaledImage",
    "BrokenImage",
    "UndeterminedCorrection",
    "DisconnectedBlock",
    "DoesNotFit",
    "NoConvergence",
}
REFUSED = {
    "AmersError",
    "InputError",
    "FormatError",
    "MissingStatements",
    "CoverageError",
    "OtherGround",
    "VerticalDatumError",
    "MissingGeoid",
    "InvalidParameter",
    "NotFound",
    "NoSuchProcess",
    "NoSuchJob",
    "Conflict",
    "DamagedFile",
    "TooLarge",
    "TooMany",
    "NotAllowed",
    "RequestRefused",
}
FAILED = {"ServiceError", "ServiceFailure", "JobFailed", "StorageOutage"}
STATUSES = {
    **dict.fromkeys(NO_RESULT, 3),
    **dict.fromkeys(REFUSED, 2),
    **dict.fromkeys(FAILED, 1),
    "PortInUse": 4,
}


class Reason(Exception):
    """Stands for an error that nobody expected."""


OUTCOMES = {
    "a computation without a result": (service_errors.NoConsensus("no consensus"), 3),
    "an input that cannot be used": (service_errors.FormatError("a.tif: no image"), 2),
    "something that does not exist": (errors.NotFound("no block"), 2),
    "a file of the user": (PermissionError(errno.EACCES, "Permission denied", "/a"), 2),
    "a connection that breaks": (ConnectionResetError("reset"), 1),
    "a bug": (Reason("a bug"), 1),
}

TO_TRY = [words for words in commands() if words != ("block", "renew")]
"""Commands; to renew a block, registrations are read first, and empty files are none."""


def kinds() -> Iterator[type[Exception]]:
    """Every error of the project."""
    for module in (errors, service_errors, client_errors):
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, Exception):
                yield value


@pytest.mark.parametrize("kind", sorted(set(kinds()), key=str), ids=lambda kind: kind.__name__)
def test_every_error_has_its_status(kind: type[Exception]) -> None:
    error = kind.__new__(kind)
    Exception.__init__(error, "what happened")
    if kind.__module__.endswith("client.errors") or issubclass(kind, errors.AmersError):
        assert exit_status(error) == STATUSES[kind.__name__]
    assert failure(error)[1] == STATUSES[kind.__name__]


@pytest.mark.parametrize(
    ("statuses", "expected"),
    [((), 0), ((0, 0), 0), ((0, 3), 3), ((3, 1), 1), ((3, 0, 2), 2), ((2, 1, 3), 1), ((130, 3), 3)],
)
def test_of_several_scenes_the_smallest_status_that_is_no_success_counts(
    statuses: tuple[int, ...], expected: int
) -> None:
    assert worst_status([{"exit_status": status} for status in statuses]) == expected


def ended(words: list[str], error: Exception, monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit status of a command in which all that it calls raises an error."""

    class Raising(Recorders):
        def of(self, function: object) -> object:
            def raising(*_arguments: object, **_named: object) -> object:
                raise error

            return raising

    Raising(monkeypatch, PACKAGE, (f"{PACKAGE}failures", f"{PACKAGE}exit_status"))
    try:
        return int(app(words, prog_name="amers", standalone_mode=False) or 0)
    except Exception as end:
        return failure(end)[1]


@pytest.mark.parametrize(("error", "status"), OUTCOMES.values(), ids=OUTCOMES)
@pytest.mark.parametrize("words", TO_TRY, ids=" ".join)
def test_every_command_ends_with_the_status_of_what_happened(
    words: tuple[str, ...],
    error: Exception,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "beside").write_text("")
    beside = [str(tmp_path / "beside") if w == "FILE" else w for w in BESIDE.get(" ".join(words), ())]
    required = [word for one in parameters(words) if one.required for word in value_of(one, tmp_path)]
    assert ended([*words, *required, *beside], error, monkeypatch) == status


RESULTS = (
    ("block quality", "block_quality.assess_stored", Anything(verdict="missed"), 3),
    ("block quality", "block_quality.assess_stored", Anything(verdict="met"), 0),
    ("db verify-backup", "db_backup.find_problems", ["a.npy: other checksum"], 2),
    ("db verify-backup", "db_backup.find_problems", [], 0),
    ("db backup", "db_backup.make_backup", Anything(damaged=[Anything(key="a", reason="b")]), 1),
    ("db backup", "db_backup.make_backup", Anything(damaged=[]), 0),
    ("store verify", "store.verify_store", Anything(findings=[], size_bytes=1.0, is_whole=False), 1),
    ("store verify", "store.verify_store", Anything(findings=[], size_bytes=1.0, is_whole=True), 0),
)


@pytest.mark.parametrize(("command", "function", "result", "status"), RESULTS)
def test_what_is_found_decides_how_a_command_ends(
    command: str,
    function: str,
    result: object,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Alone, and with each of its options."""
    own = parameters(tuple(command.split()))
    given = [word for one in own if one.required for word in value_of(one, tmp_path)]
    given += ["--points-per-km2", "1"] if command == "block quality" else []
    Recorders(monkeypatch, PACKAGE, (f"{PACKAGE}failures", f"{PACKAGE}exit_status"))
    monkeypatch.setattr(f"{PACKAGE}{function}", lambda *_arguments, **_named: result)
    monkeypatch.setattr(f"{PACKAGE}block_quality._show_report", lambda *_arguments, **_named: None)
    monkeypatch.setattr(f"{PACKAGE}output._as_json", str)
    for option in ([], *(value_of(one, tmp_path) for one in own if not one.required)):
        words = [*command.split(), *given, *option]
        # Some options are refused without others.
        with contextlib.suppress(errors.InputError):
            assert (app(words, prog_name="amers", standalone_mode=False) or 0) == status, option
