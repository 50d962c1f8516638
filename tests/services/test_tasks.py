"""Tasks: kept by name, computed once, independent of the order in which they end."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from amers.services.tasks import Arrays, Work


def doubled(value: int) -> Arrays:
    return {"value": np.array([2 * value])}


def named(count: int) -> list[tuple[str, Callable[[], tuple[int]]]]:
    return [(f"doubled/{i}", partial(tuple, [i])) for i in range(count)]


def test_results_are_kept_by_name_and_progress_reaches_the_end() -> None:
    work, seen = Work(), []
    work.run(doubled, named(5), lambda fraction, message: seen.append((fraction, message)))
    assert [int(work.kept[f"doubled/{i}"]["value"][0]) for i in range(5)] == [0, 2, 4, 6, 8]
    assert seen[-1] == (1.0, "doubled: 5 of 5")
    assert [fraction for fraction, _ in seen] == sorted(fraction for fraction, _ in seen)


def test_progress_says_how_long_the_rest_takes_at_the_rate_of_computed_tasks() -> None:
    work, seen = Work(kept={"busy/0": {}}), []
    work.run(
        busy, [(f"busy/{i}", partial(tuple, [0.3])) for i in range(12)], lambda _, m: seen.append(m)
    )
    left = [message.partition(", ")[2] for message in seen]
    assert left[0] == ""
    assert seen[-1] == "busy: 12 of 12"
    first_s = float(next(words for words in left if words).split()[0])
    # Eleven are computed, ten after the first one: of 0.3 s on a free machine.
    assert first_s >= 2.0


def test_what_is_kept_is_not_computed_again() -> None:
    work = Work()
    work.kept["doubled/1"] = {"value": np.array([99])}
    computed = []

    def noted(value: int) -> Arrays:
        computed.append(value)
        return doubled(value)

    work.run(noted, named(3))
    assert computed == [0, 2]
    assert int(work.kept["doubled/1"]["value"][0]) == 99


def busy(seconds: float) -> Arrays:
    begun = time.thread_time()
    while time.thread_time() - begun < seconds:
        pass
    return {}


def test_the_effort_of_each_stage_is_that_of_its_computed_tasks() -> None:
    with ThreadPoolExecutor(2) as executor:
        work = Work(executor, {"busy/0": {}})
        work.run(busy, [(f"busy/{i}", partial(tuple, [0.1])) for i in range(3)])
        work.run(doubled, named(4))
    assert work.effort["busy"].tasks == 2
    # Of one thread each: what others do at the same time does not count.
    assert 0.2 <= work.effort["busy"].cpu_s < 0.4
    assert work.effort["doubled"].tasks == 4


def test_an_error_ends_the_work_and_keeps_what_had_ended() -> None:
    def failing(value: int) -> Arrays:
        if value == 3:
            raise ValueError("three")
        return doubled(value)

    work = Work()
    with pytest.raises(ValueError, match="three"):
        work.run(failing, named(10))
    assert {"doubled/0", "doubled/1", "doubled/2"} <= set(work.kept)
    assert "doubled/3" not in work.kept
    assert len(work.kept) < 6


def test_arguments_of_few_tasks_are_in_memory_at_once() -> None:
    begun, ended, most = [], [], []

    def arguments(value: int) -> tuple[int]:
        begun.append(value)
        most.append(len(begun) - len(ended))
        return (value,)

    class Kept(dict[str, Arrays]):
        def __setitem__(self, name: str, arrays: Arrays) -> None:
            ended.append(name)
            super().__setitem__(name, arrays)

    with ThreadPoolExecutor(8) as executor:
        Work(executor, Kept(), ahead=3).run(
            doubled, [(f"d/{i}", partial(arguments, i)) for i in range(50)]
        )
    assert max(most) == 3


def test_results_do_not_depend_on_which_task_ends_first() -> None:
    second_has_ended = threading.Event()

    def in_reverse(value: int) -> Arrays:
        if value == 0:
            assert second_has_ended.wait(10.0)
        else:
            second_has_ended.set()
        return doubled(value)

    with ThreadPoolExecutor(2) as executor:
        work = Work(executor, ahead=2)
        work.run(in_reverse, named(2))
    assert [int(work.kept[f"doubled/{i}"]["value"][0]) for i in range(2)] == [0, 2]
