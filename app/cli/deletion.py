"""Commands that delete: on a full disk they go on without the reserve."""

from collections.abc import Callable
from functools import partial, wraps
from typing import ParamSpec

from amers.app import reserve
from amers.app.config import read_settings

Parameters = ParamSpec("Parameters")


def giving_up_reserve(command: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """The same command; when it meets a full disk, it is run again without the reserve."""

    @wraps(command)
    def delete(*arguments: Parameters.args, **options: Parameters.kwargs) -> None:
        reserve.deleting(read_settings(), partial(command, *arguments, **options))

    return delete
