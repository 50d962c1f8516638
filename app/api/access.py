"""Who may use an operation, as its dependencies declare it for the description of the API.

A dependency that checks the caller is marked with what it demands. The description of each operation
gets its `security` from there, and `tests/app/test_access_matrix.py` tries every operation with every
kind of caller. An operation without such a dependency has no declaration, which that test refuses.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from fastapi import Depends
from fastapi.dependencies.models import Dependant

from amers.app.api.credentials import BASIC, BEARER
from amers.app.auth import Scope
from amers.app.config import Settings

FURTHER_SCOPES = "x-further-scopes"
"""Member of an operation: the scopes that some of its inputs need in addition to its own."""

Dependency = TypeVar("Dependency", bound=Callable[..., Any])


@dataclass(frozen=True)
class Access:
    """What an operation demands of its caller.

    Attributes:
        scope: of the token; None: any valid token.
        public_if: the setting that opens the operation to callers without a token.
    """

    scope: Scope | None
    public_if: Literal["public_points", "public_metrics"] | None = None

    def requirements(self, settings: Settings) -> list[dict[str, list[str]]]:
        """The member `security` of the operation in the OpenAPI description."""
        scopes = [] if self.scope is None else [str(self.scope)]
        public = self.public_if is not None and bool(getattr(settings, self.public_if))
        return [*either_scheme(scopes), *([{}] if public else [])]


def either_scheme(scopes: list[str]) -> list[dict[str, list[str]]]:
    """The requirement of a token with these scopes, whichever way it is sent."""
    return [{BEARER: scopes}, {BASIC: scopes}]


_DECLARED: dict[Callable[..., Any], Access | None] = {}


def needs(
    scope: Scope | None, public_if: Literal["public_points", "public_metrics"] | None = None
) -> Callable[[Dependency], Dependency]:
    """Mark a dependency with the access that it checks."""

    def mark(dependency: Dependency) -> Dependency:
        _DECLARED[dependency] = Access(scope, public_if)
        return dependency

    return mark


async def _nobody_is_checked() -> None:
    """The dependency of operations that are open to everybody."""


_DECLARED[_nobody_is_checked] = None
Public = Depends(_nobody_is_checked)
"""Declares an operation to be open to everybody."""


def declared_security(dependant: Dependant, settings: Settings) -> list[dict[str, list[str]]] | None:
    """The member `security` of an operation with these dependencies; None: none declares it."""
    declared = [_DECLARED[call] for call in _calls(dependant) if call in _DECLARED]
    if not declared:
        return None
    assert len(set(declared)) == 1, f"{declared}: an operation has one declaration of its access"
    return [{}] if declared[0] is None else declared[0].requirements(settings)


def _calls(dependant: Dependant) -> Iterator[Callable[..., Any]]:
    for inner in dependant.dependencies:
        if inner.call is not None:
            yield inner.call
        yield from _calls(inner)
