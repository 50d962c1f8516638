"""Everything that is computed of small worlds is what it was, figure by figure.

Other tests say what must hold: errors are small, what is stated is true. A change that moves a figure
within what holds is noticed here, by its name; whether it is meant, a person decides. After one that is
meant, `python -m tests.services.test_all_figures` writes the figures anew; read what differs.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.results import rigorous_scene, scene_adjustment
from amers.services.registration.options import RegistrationOptions
from tests.services.joint import test_joint_block as joint
from tests.services.joint import test_rigorous_scenes as rigorous
from tests.services.orthorectification import test_rectify as rectified
from tests.services.registration import test_distorted_scenes as distorted
from tests.services.registration import test_on_points as on_points
from tests.services.registration import test_on_reference as on_reference
from tests.services.simulated import block, production
from tests.services.surface import test_surface as surfaces

pytestmark = pytest.mark.long

GOLDEN = Path(__file__).parents[1] / "golden" / "all_figures.json"
RELATIVE, ABSOLUTE = 1e-3, 1e-6
"""By what figures may differ: sums in another order, which decide nothing, change them by less."""
LEFT_OUT = ("seconds", "cpu_s", "effort", "scenes", "image", "base")
"""Members that are no results: what a run took, and what it was given."""
_DEEPEST = 7


def _joint_block() -> Any:
    rng = np.random.default_rng(7)
    block, left = adjust_fitting(*joint.observed(joint.truth_of(rng), rng), RegistrationOptions())
    return block, left, [scene_adjustment(block, number, RegistrationOptions()) for number in range(3)]


def _rigorous_block() -> Any:
    rng = np.random.default_rng(8)
    block, left = adjust_fitting(*rigorous.observed(rigorous.mixed(rng), rng), RegistrationOptions())
    return block, left, [rigorous_scene(block, number) for number in range(2)]


def _ortho_image() -> Any:
    ground = rectified.terrain()
    return rectified.assembled(
        rectified.ramps(), ground, rectified.choose_grid(rectified.scene(), ground), hide=True
    )


WORLDS: dict[str, Callable[[], Any]] = {
    "production": production,
    "points": lambda: block()[0],
    "chips": lambda: block()[1].chips.astype(np.float64),
    "registration on points": lambda: on_points.registration(on_points.FIRST),
    "registration on a reference": on_reference.registered,
    "registration with jitter": lambda: distorted.registered("jitter"),
    "registration with ground that moved": lambda: distorted.registered("moved ground"),
    "scenes together": _joint_block,
    "scenes of orbits together": _rigorous_block,
    "ortho-image": _ortho_image,
    "surface": surfaces.pair,
    "surface of three": surfaces.triplet,
}
"""What is computed, by its name."""


def figures(value: object, path: str = "", depth: int = 0) -> Iterator[tuple[str, list[float | str]]]:
    """The numbers and words in a result, each after the path that leads to it.

    Of an array: its shape, how many are none, and of each column of two or three, or of all numbers, the
    mean, the standard deviation, the first and the last.
    """
    if isinstance(value, bool | int | float | np.number):
        yield path, [float(value)]
    elif isinstance(value, str | Enum):
        yield path, [str(value)]
    elif isinstance(value, np.ndarray):
        yield path, list(_of_array(value))
    elif depth < _DEEPEST:
        for name, part in _parts(value).items():
            yield from figures(part, path + name, depth + 1)


def _parts(value: object) -> dict[str, object]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {f".{name}": getattr(value, name) for name in names if name not in LEFT_OUT}
    if isinstance(value, dict):
        return {f"[{key}]": part for key, part in value.items()}
    if isinstance(value, list | tuple):
        return {f"[{number}]": part for number, part in enumerate(value)}
    return {}


def _of_array(values: np.ndarray) -> Iterator[float | str]:
    yield "x".join(map(str, values.shape))
    if values.dtype.kind not in "biuf":
        yield from (str(one) for one in np.unique(values))
        return
    columns = values.astype(np.float64)
    columns = columns.reshape(-1, values.shape[-1] if values.ndim > 1 and values.shape[-1] <= 3 else 1)
    yield float((~np.isfinite(columns)).sum())
    for column in columns.T:
        known = column[np.isfinite(column)]
        if known.size:
            yield from map(float, (known.mean(), known.std(), known[0], known[-1]))


def found(name: str) -> dict[str, list[float | str]]:
    """The figures of one world."""
    return {path: [_short(one) for one in values] for path, values in figures(WORLDS[name]())}


def _short(one: float | str) -> float | str:
    return one if isinstance(one, str) else float(f"{one:.8g}")


def _differs(one: list[float | str], other: list[float | str] | None) -> bool:
    """Whether figures differ by more than a computer does."""
    if other is None or len(one) != len(other):
        return True
    words = [(a, b) for a, b in zip(one, other, strict=True) if isinstance(a, str) or isinstance(b, str)]
    numbers = [(a, b) for a, b in zip(one, other, strict=True) if (a, b) not in words]
    if any(a != b for a, b in words):
        return True
    # A mean of many that nearly cancel is compared with what they are made of.
    scale = max((abs(float(b)) for _, b in numbers if np.isfinite(float(b))), default=0.0)
    return not all(
        np.isclose(float(a), float(b), RELATIVE, ABSOLUTE * max(scale, 1.0), equal_nan=True)
        for a, b in numbers
    )


@pytest.mark.parametrize("name", WORLDS)
def test_every_figure_is_what_it_was(name: str) -> None:
    expected, now = json.loads(GOLDEN.read_text())[name], found(name)
    assert sorted(now) == sorted(expected)
    differing = [path for path in now if _differs(now[path], expected[path])]
    assert not {path: (expected[path], now[path]) for path in differing}


def _written(name: str) -> str:
    """The figures of one world, a line each."""
    rows = [f" {json.dumps(path)}: {json.dumps(values)}" for path, values in found(name).items()]
    return json.dumps(name) + ": {\n" + ",\n".join(rows) + "\n}"


if __name__ == "__main__":
    GOLDEN.write_text("{\n" + ",\n".join(map(_written, WORLDS)) + "\n}\n")
