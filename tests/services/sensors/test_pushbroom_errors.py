"""Terms of a rigorous model move its image as the geometry says, and derivatives as differences do."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.geodesy import ecef_from_lon_lat_h
from amers.services.sensors import parameter_sets
from amers.services.sensors.light_path import LightPath
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.simulation.orbit import pushbroom_over

SHAPE = (3000, 2000)
size = np.array([1e-5, 1e-5, 1e-3, 1e-5, 1e-5, 1e-3, 10.0, 10.0, 10.0, 0.5, 0.5, 0.5, 1e-3, 1e-3])
"""Terms that displace an image of 2.5 m by some pixels, orbit drifts by less: they change aberration."""
a_millipixel = 1e-3


def a_model(azimuth_deg: float = 75.0) -> PushbroomModel:
    rng = np.random.default_rng(4)
    target = np.array([5.4, 43.6, 250.0])
    view = (25.0, azimuth_deg)
    return pushbroom_over(target, SHAPE, 2.5, view, (0.0, 1500.0), jitter_px=0.5, rng=rng)


def with_a_mirror(model: PushbroomModel, ahead: float = 0.01) -> PushbroomModel:
    """The same with central tangents along and across of 0.01 and 0.4, as SPOT 1 to 5 have them.

    Cameras for stereo look ahead and back by a tangent of some tenths.
    """
    look = model.look.coefficients.copy()
    look[:, :, -1] += [ahead, 0.4]
    return replace(model, look=replace(model.look, coefficients=look))


def with_a_bent_detector(model: PushbroomModel) -> PushbroomModel:
    """The same whose detectors look farther ahead towards the right, by 20 px at its border."""
    look, half = model.look.coefficients.copy(), np.diff(model.look.breaks)[:, None] / 2.0
    pixel = np.ptp(model.look(np.array([0.0, SHAPE[1] - 1.0]))[:, 1]) / SHAPE[1]
    look[:, :1, -2] += 20.0 * pixel * half / (SHAPE[1] / 2.0)
    return replace(model, look=replace(model.look, coefficients=look))


def ground_in(model: PushbroomModel, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(11)
    return model.locate(rng.uniform(0.0, 1.0, (count, 2)) * SHAPE, rng.uniform(0.0, 1500.0, count))


@pytest.mark.parametrize(
    "model",
    [
        a_model(),
        a_model(250.0),
        replace(a_model(), light_path=LightPath(True, True, True)),
        with_a_bent_detector(a_model()),
        with_a_mirror(a_model(), ahead=0.15),
        with_a_mirror(a_model(), ahead=-0.15),
    ],
    ids=["east", "west", "light", "bent", "ahead", "back"],
)
@pytest.mark.parametrize("term", range(len(TERMS)), ids=TERMS)
def test_derivatives_agree_with_differences_of_exact_models(model: PushbroomModel, term: int) -> None:
    errors, ground = PushbroomErrors(model), ground_in(model)
    at = size * np.random.default_rng(7).uniform(-0.3, 0.3, len(TERMS))
    step = np.zeros(len(TERMS))
    step[term] = size[term]
    after, before = (errors.corrected(at + sign * step).project(ground) for sign in (0.5, -0.5))
    image, _, by_terms = errors.projected(at, ground)
    np.testing.assert_allclose(image, errors.corrected(at).project(ground), atol=1e-9)
    predicted = by_terms[:, :, term] * size[term]
    assert np.abs(predicted).max() > 20.0 * a_millipixel
    np.testing.assert_allclose(predicted, after - before, atol=a_millipixel)


def test_no_terms_leave_the_model_as_it_is() -> None:
    model = a_model()
    ground = ground_in(model)
    unchanged = PushbroomErrors(model).corrected(np.zeros(len(TERMS)))
    np.testing.assert_allclose(unchanged.project(ground), model.project(ground), atol=1e-9)


@pytest.mark.parametrize("mirror", [False, True])
def test_turns_are_about_the_axes_of_the_central_line_of_sight(mirror: bool) -> None:
    model = with_a_mirror(a_model()) if mirror else a_model()
    centre = (np.array([SHAPE]) - 1.0) / 2.0
    directions = {}
    for name, turn in (("none", 0), ("roll", 1), ("pitch", 2), ("yaw", 3)):
        terms = np.zeros(len(TERMS))
        terms[turn - 1] = 1e-3 if turn else 0.0
        corrected = PushbroomErrors(model).corrected(terms)
        directions[name] = corrected.line_of_sight(centre)[1][0]
    # A turn by a milliradian moves the line of sight by as much, but for the one about itself.
    angle = {name: np.linalg.norm(d - directions["none"]) for name, d in directions.items()}
    assert angle["yaw"] < 1e-12
    assert angle["roll"] == pytest.approx(1e-3, rel=1e-6)
    assert angle["pitch"] == pytest.approx(1e-3, rel=1e-6)
    velocity = model.orbit.derivative(np.zeros(1))[0]
    forwards = velocity / np.linalg.norm(velocity)
    moved = {name: (directions[name] - directions["none"]) @ forwards for name in ("roll", "pitch")}
    # To pitch is to look forwards, in the sense of x to z about y.
    assert abs(moved["pitch"]) > 0.9e-3
    assert abs(moved["roll"]) < 0.4e-3


def test_drifts_are_zero_at_the_middle_and_whole_at_the_last_line() -> None:
    model = a_model()
    lines = np.column_stack([[0.0, (SHAPE[0] - 1.0) / 2.0, SHAPE[0] - 1.0], np.full(3, 1000.0)])
    origin = model.line_of_sight(lines)[0]
    terms = np.zeros(len(TERMS))
    terms[TERMS.index("radial drift")] = 5.0
    moved = PushbroomErrors(model).corrected(terms).line_of_sight(lines)[0] - origin
    upwards = (moved * origin).sum(axis=1) / np.linalg.norm(origin, axis=1)
    np.testing.assert_allclose(upwards, [-5.0, 0.0, 5.0], atol=1e-4)


def test_a_displaced_satellite_sees_the_ground_displaced_the_other_way() -> None:
    model = a_model()
    ground = ground_in(model)
    terms = np.zeros(len(TERMS))
    terms[TERMS.index("across track")] = 30.0
    moved = PushbroomErrors(model).corrected(terms)
    position = model.project(ground)
    found = moved.locate(position, ground[:, 2])
    step = ecef_from_lon_lat_h(found) - ecef_from_lon_lat_h(ground)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 30.0, rtol=0.02)


def test_anisotropy_moves_nothing_along_the_track() -> None:
    """Of detectors that look ahead, the focal length makes both tangents longer, anisotropy one."""
    model = with_a_bent_detector(a_model())
    samples = np.column_stack([np.full(3, 1500.0), [0.0, 1000.0, SHAPE[1] - 1.0]])
    before = model.look(samples[:, 1])
    central = model.look(np.array([(SHAPE[1] - 1.0) / 2.0]))
    for term, grown in (("focal length", [1e-3, 1e-3]), ("anisotropy", [0.0, 1e-3])):
        terms = np.zeros(len(TERMS))
        terms[TERMS.index(term)] = 1e-3
        after = PushbroomErrors(model).corrected(terms).look(samples[:, 1])
        np.testing.assert_allclose(after - before, (before - central) * grown, atol=1e-12)


@pytest.mark.parametrize("drift", [False, True])
def test_the_orbit_moves_ahead_to_the_right_and_upwards(drift: bool) -> None:
    model = a_model()
    last = np.array([[SHAPE[0] - 1.0 if drift else (SHAPE[0] - 1.0) / 2.0, 1000.0]])
    origin = model.line_of_sight(last)[0][0]
    up = origin / np.linalg.norm(origin)
    velocity = model.orbit.derivative(model.line_time(last[:, 0])[:, 0])[0]
    right = np.cross(velocity, up) / np.linalg.norm(np.cross(velocity, up))
    names = ("along-track drift", "across-track drift", "radial drift")
    names = names if drift else ("along track", "across track", "radial")
    for name, axis in zip(names, (np.cross(up, right), right, up), strict=True):
        terms = np.zeros(len(TERMS))
        terms[TERMS.index(name)] = 5.0
        moved = PushbroomErrors(model).corrected(terms).line_of_sight(last)[0][0] - origin
        np.testing.assert_allclose(moved, 5.0 * axis, atol=0.02)


@pytest.mark.parametrize("order", [1, -1])
def test_every_term_is_as_free_as_the_set_that_trusts_it_least(
    order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In whatever order the sets are listed; terms of the set itself keep their own sigmas."""
    sets = parameter_sets.PARAMETER_SETS
    monkeypatch.setattr(parameter_sets, "PARAMETER_SETS", dict(list(sets.items())[::order]))
    assert set().union(*(one.sigmas for one in sets.values())) <= set(TERMS)
    for own in sets.values():
        free = parameter_sets.with_every_term(own).sigmas
        for term, sigma in free.items():
            others = [one.sigmas.get(term, 0.0) for one in sets.values()]
            assert sigma == own.sigmas.get(term, max(others))
        assert set(parameter_sets.left_out_of(own)) == set(free) - set(own.sigmas)
