"""Everything that is computed of small worlds is what it was, figure by figure.

Other tests say what must hold: errors are small, what is stated is true. A change that moves a figure
within what holds is noticed here, by its name; whether it is meant, a person decides. After one that is
meant, `python -m tests.services.test_all_figures` writes the figures anew; read what differs.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.results import rigorous_scene, scene_adjustment
from amers.services.registration.options import RegistrationOptions
from tests.services.figures import Figures, differing, figures
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
LEFT_OUT = {"seconds", "cpu_s", "effort", "scenes", "image", "base"}
"""Members that are no results: what a run took, and what it was given."""


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


def found(name: str) -> Figures:
    """The figures of one world."""
    return figures(WORLDS[name](), LEFT_OUT)


@pytest.mark.parametrize("name", WORLDS)
def test_every_figure_is_what_it_was(name: str) -> None:
    expected, now = json.loads(GOLDEN.read_text())[name], found(name)
    assert not differing(now, expected)


def _written(name: str) -> str:
    """The figures of one world, a line each."""
    rows = [f" {json.dumps(path)}: {json.dumps(values)}" for path, values in found(name).items()]
    return json.dumps(name) + ": {\n" + ",\n".join(rows) + "\n}"


if __name__ == "__main__":
    GOLDEN.write_text("{\n" + ",\n".join(map(_written, WORLDS)) + "\n}\n")
