"""The numbers and words in a result, to compare it with what it was."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from datetime import date
from enum import Enum

import numpy as np

Figures = dict[str, list[float | str]]
"""By the path that leads to them."""
COMPUTED, READ = 1e-3, 1e-7
"""By what part figures may differ that were computed or read: sums in another order, which decide
nothing, change them by less."""
_ABSOLUTE = 1e-3
"""The same of numbers that are nearly zero, in these parts of the largest beside them, or of one."""
_DEEPEST = 7


def figures(value: object, left_out: Collection[str] = ()) -> Figures:
    """The numbers and words in a result, each after the path that leads to it.

    Of an array: its shape, how many are none, and of each column of two or three, or of all numbers, the
    mean, the standard deviation, the first and the last.

    Args:
        value: anything; what has no members that are known is left out.
        left_out: members of data classes that are no results.
    """
    return {path: [_short(one) for one in values] for path, values in _figures(value, left_out, "", 0)}


def differing(
    now: Figures, expected: Figures, relative: float = COMPUTED
) -> dict[str, tuple[object, object]]:
    """The figures that are missing, new, or differ by more than a part: as expected, and now."""
    paths = dict.fromkeys((*expected, *now))
    return {
        path: (expected.get(path), now.get(path))
        for path in paths
        if path not in now or _differs(now[path], expected.get(path), relative)
    }


def _figures(
    value: object, left_out: Collection[str], path: str, depth: int
) -> Iterator[tuple[str, list[float | str]]]:
    if isinstance(value, bool | int | float | np.number):
        yield path, [float(value)]
    elif isinstance(value, str | Enum | date):
        yield path, [str(value)]
    elif isinstance(value, np.ndarray):
        yield path, list(_of_array(value))
    elif depth < _DEEPEST:
        for name, part in _parts(value, left_out).items():
            yield from _figures(part, left_out, path + name, depth + 1)


def _parts(value: object, left_out: Collection[str]) -> Mapping[str, object]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {f".{name}": getattr(value, name) for name in names if name not in left_out}
    if isinstance(value, dict):
        return {f"[{key}]": part for key, part in value.items()}
    if isinstance(value, list | tuple):
        return {f"[{number}]": part for number, part in enumerate(value)}
    return {}


def _of_array(values: np.ndarray) -> Iterator[float | str]:
    yield "x".join(map(str, values.shape))
    if values.dtype.kind not in "biuf":
        yield from sorted({str(one) for one in values.ravel()})
        return
    columns = values.astype(np.float64)
    columns = columns.reshape(-1, values.shape[-1] if values.ndim > 1 and values.shape[-1] <= 3 else 1)
    yield float((~np.isfinite(columns)).sum())
    for column in columns.T:
        known = column[np.isfinite(column)]
        if known.size:
            yield from map(float, (known.mean(), known.std(), known[0], known[-1]))


def _short(one: float | str) -> float | str:
    return one if isinstance(one, str) else float(f"{one:.8g}")


def _differs(one: list[float | str], other: list[float | str] | None, relative: float) -> bool:
    if other is None or len(one) != len(other):
        return True
    words = [(a, b) for a, b in zip(one, other, strict=True) if isinstance(a, str) or isinstance(b, str)]
    numbers = [(a, b) for a, b in zip(one, other, strict=True) if (a, b) not in words]
    if any(a != b for a, b in words):
        return True
    # A mean of many that nearly cancel is compared with what they are made of.
    scale = max((abs(float(b)) for _, b in numbers if np.isfinite(float(b))), default=0.0)
    return not all(
        np.isclose(float(a), float(b), relative, _ABSOLUTE * relative * max(scale, 1.0), equal_nan=True)
        for a, b in numbers
    )
