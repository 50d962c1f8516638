"""Everything that is computed of small worlds is what it was, figure by figure.

Other tests say what must hold: errors are small, what is stated is true. A change that moves a figure
within what holds is noticed here, by its name; whether it is meant, a person decides. After one that is
meant, `python -m tests.services.test_all_figures` writes the figures anew; read what differs.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.results import rigorous_scene, scene_adjustment
from amers.services.quality.accuracy import accuracy, normalised_error, statistics
from amers.services.registration.options import RegistrationOptions
from amers.services.types import Frame
from amers.services.vectors.accuracy import ErrorSources
from tests.services import judged_worlds as judged
from tests.services.adjustment import test_block_control as controlled
from tests.services.figures import Figures, differing, figures
from tests.services.joint import test_joint_block as joint
from tests.services.joint import test_rigorous_scenes as rigorous
from tests.services.misfit import test_marked_scene as marked
from tests.services.mosaic import worlds as mosaics
from tests.services.orthorectification import test_rectify as rectified
from tests.services.production import test_planning as planned
from tests.services.registration import test_distorted_scenes as distorted
from tests.services.registration import test_on_points as on_points
from tests.services.registration import test_on_reference as on_reference
from tests.services.simulated import block, production
from tests.services.surface import test_surface as surfaces
from tests.services.vectors import test_correct as vectors

pytestmark = pytest.mark.long

GOLDEN = Path(__file__).parents[1] / "golden" / "all_figures.json"
LEFT_OUT = {"seconds", "cpu_s", "effort", "scenes", "image", "base", "geometries", "parts"}
"""Members that are no results: what a run took, and what it was given; and shapes, of which the vertices
are."""


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


def _vectors() -> Any:
    frame = Frame(np.array([[1.5, 0.4, 0.0], [0.4, 2.0, 0.3], [0.0, 0.3, 4.0]]))
    ground = replace(vectors.terrain(30.0), sigmas=3.0)
    lines = vectors.shapes_of(vectors.long_lines(12))
    sources = ErrorSources(vectors.registered(frame), np.nan, 0.5)
    there = vectors.correct_vectors(
        lines, vectors.scene(), ground, vectors.CRS, sources=sources, tolerance_px=0.2
    )
    return there, vectors.project_vectors(
        there.shapes, vectors.scene(), ground, vectors.CRS, tolerance_px=0.2
    )


def _mosaic() -> Any:
    """Of three levels, the second scene with a model that is off."""
    gains, off_px = ((1.0, 0.0), (1.3, -80.0), (0.7, 150.0)), ((0.0, 0.0), (0.4, 0.25), (0.0, 0.0))
    scenes = [
        mosaics.scene(k, *mosaics.cut_out(k, gain=gain, offset=offset, off_px=off))
        for k, ((gain, offset), off) in enumerate(zip(gains, off_px, strict=True))
    ]
    mosaic = mosaics.mosaic_of(scenes, level=True)
    return mosaic.grid, mosaic.levels, mosaic.steps, mosaic.pair_steps, mosaics.assembled(mosaic)


def _block_on_control() -> Any:
    rng = np.random.default_rng([3, 1])
    truth, images, observations = controlled.draw(controlled.CASE, rng)
    control = controlled.known_ground(truth, rng, wrong=2)
    return controlled.adjust_block(images, observations, control=control)


def _marked_scene() -> Any:
    rng = np.random.default_rng(5)
    marks = marked.marks_of(rng, 8, marked.of_a_map_m, marked.truth(rng))
    return marked.adjust_marks(marked.MODEL, marked.SHAPE, marked.with_blunder(marks), marked.PRIORS)


def _accuracy() -> Any:
    """Of errors that groups share, beside what is declared of them."""
    rng, group = np.random.default_rng(6), np.repeat(np.arange(8), 5)
    error_m = rng.normal([0.3, -0.2, 0.9], [0.8, 1.1, 2.0], (40, 3)) + rng.normal(size=(8, 3))[group]
    declared_m2 = np.tile(np.diag([1.5, 2.0, 5.0]), (40, 1, 1)) + 0.4
    return accuracy(error_m, group), normalised_error(error_m, declared_m2), statistics(error_m[:, 2])


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
    "plan of a block": lambda: planned.forecast(planned.MIXED),
    "sites that are proposed": lambda: planned.forecast(planned.PLAN),
    "block on control": _block_on_control,
    "marks in a scene": _marked_scene,
    "mosaic": _mosaic,
    "vectors": _vectors,
    "accuracy": _accuracy,
    **judged.WORLDS,
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
