"""Turns: how much is done at once, in all and for one caller."""

from collections import deque
from collections.abc import Hashable

from anyio import Event, fail_after
from starlette.exceptions import HTTPException

RETRY = {"Retry-After": "5"}


class Turns:
    """A limit on what is done at once, which one caller cannot use up.

    Who waits gets the next free turn in the order of callers, not of requests: a caller with a hundred
    requests delays another's first one by one turn. For use in one event loop.

    Attributes:
        what: is done, in the plural, for messages.
        most: turns in all.
        most_per_caller: turns of one caller.
        patience_s: longest wait for a turn.
    """

    def __init__(self, what: str, most: int, most_per_caller: int, patience_s: float) -> None:
        self.what = what
        self.most = most
        self.most_per_caller = most_per_caller
        self.patience_s = patience_s
        self.free = most
        self._taken: dict[Hashable, int] = {}
        self._waiting: dict[Hashable, deque[Event]] = {}

    async def take(self, caller: Hashable) -> None:
        """Wait for a turn; `release` ends it.

        Raises:
            HTTPException: there was none in time, because of the caller's own (429) or others' (503).
        """
        if self._may_take(caller):
            self._grant(caller)
            return
        granted = Event()
        queue = self._waiting.setdefault(caller, deque())
        queue.append(granted)
        try:
            with fail_after(self.patience_s):
                await granted.wait()
        except BaseException as error:
            if granted.is_set():
                self.release(caller)
            else:
                queue.remove(granted)
                if not queue:
                    del self._waiting[caller]
            if isinstance(error, TimeoutError):
                raise self._refusal(caller) from None
            raise

    def release(self, caller: Hashable) -> None:
        """End a turn, and give it to the next caller who waits and may have one."""
        self.free += 1
        self._taken[caller] -= 1
        if not self._taken[caller]:
            del self._taken[caller]
        for waiting in list(self._waiting):
            if not self.free:
                break
            if self._may_take(waiting):
                # Behind all others: callers get turns in a circle.
                queue = self._waiting.pop(waiting)
                queue.popleft().set()
                self._grant(waiting)
                if queue:
                    self._waiting[waiting] = queue

    def _may_take(self, caller: Hashable) -> bool:
        return self.free > 0 and self._taken.get(caller, 0) < self.most_per_caller

    def _grant(self, caller: Hashable) -> None:
        self.free -= 1
        self._taken[caller] = self._taken.get(caller, 0) + 1

    def _refusal(self, caller: Hashable) -> HTTPException:
        own = self._taken.get(caller, 0)
        if own >= self.most_per_caller:
            detail = f"{own} {self.what} of this caller are in progress, the most at once: try again"
            return HTTPException(429, detail, RETRY)
        detail = f"{self.most - self.free} {self.what} are in progress, the most at once: try again"
        return HTTPException(503, detail, RETRY)
