"""Exit statuses of the commands.

| status | meaning |
|---|---|
| 0 | success |
| 1 | any other failure: no answer of a service, a killed process, damaged files of the store, a bug |
| 2 | the input, a backup or the installation cannot be used |
| 3 | the scene could not be registered, or its verdict is failed; the block misses its specification |
| 4 | another program uses the port of the service |
| 130 | interrupted |
"""

import sys

from amers.app.errors import AmersError, ComputationError, PortInUse

SUCCESS = 0
FAILURE = 1
REFUSED = 2
NO_RESULT = 3
PORT_IN_USE = 4
INTERRUPTED = 130


def exit_status(error: Exception) -> int:
    """The exit status of a command that an error ended."""
    if isinstance(error, ComputationError):
        return NO_RESULT
    if isinstance(error, PortInUse):
        return PORT_IN_USE
    return REFUSED if is_refusal(error) else FAILURE


def is_refusal(error: Exception) -> bool:
    """Whether the input or the request cannot be used, by Amers or by a service that was asked."""
    if isinstance(error, AmersError):
        return True
    # Commands that ask no service do not import its client.
    client = sys.modules.get("amers.app.client.errors")
    return client is not None and isinstance(error, client.RequestRefused)
