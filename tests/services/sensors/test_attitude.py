"""Attitudes from quaternions of any sign, and from rates integrated from known angles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amers.services.sensors.attitude import integrated_rates, interpolated_attitude, orbital_attitude
from amers.services.sensors.piecewise import polynomial

rounding = 1e-12


def test_quaternions_of_any_sign_and_length_are_one_smooth_rotation() -> None:
    times = np.linspace(0.0, 2.0, 15)

    def turned(t: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(np.outer(t, [0.01, 3.0, -0.02]))

    quaternions = turned(times).as_quat() * np.resize([1.0, -2.0, -0.5], 15)[:, None]
    t = np.linspace(0.0, 2.0, 50)
    found = Rotation.from_quat(interpolated_attitude(times, quaternions)(t))
    assert (found * turned(t).inv()).magnitude().max() < 1e-5


@pytest.mark.parametrize("known_s", [-0.5, 0.0, 0.7, 3.0, 4.0])
def test_rates_are_integrated_exactly_from_angles_known_at_any_time(known_s: float) -> None:
    times = np.array([0.0, 0.5, 1.5, 3.0])
    rates = np.array([[1.0], [2.0], [-1.0], [4.0]])
    known = np.array([10.0])
    angles = integrated_rates(times, rates, (known_s, known))
    edge = {-0.5: 1.0 * 0.5, 4.0: -4.0 * 1.0}.get(known_s, 0.0)
    inside = np.clip(known_s, 0.0, 3.0)
    assert angles(np.array([inside]))[0, 0] == pytest.approx(10.0 + edge, abs=rounding)
    t = np.linspace(0.0, 3.0, 3001)
    rate = np.interp(t, times, rates[:, 0])
    np.testing.assert_allclose(angles.derivative(t[1:-1])[:, 0], rate[1:-1], atol=0.02)
    trapezoid = np.sum((rate[1:] + rate[:-1]) / 2.0 * np.diff(t))
    change = angles(np.array([3.0])) - angles(np.array([0.0]))
    assert change[0, 0] == pytest.approx(trapezoid, abs=1e-9)


def about(axis: int, angle: float) -> np.ndarray:
    """The rotation (3, 3) by an angle about an axis x, y or z."""
    out, (j, k) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    out[j, j] = out[k, k] = np.cos(angle)
    out[j, k], out[k, j] = -np.sin(angle), np.sin(angle)
    return out


def test_a_body_pitches_rolls_and_yaws_in_this_order_from_its_orbit() -> None:
    """Seen along its axes, large angles: the order of the turns and their senses matter."""
    yaw, pitch, roll = 0.3, -0.5, 0.2
    position, ahead = np.array([4e6, -5e6, 3e6]), np.array([3000.0, 4000.0, 5000.0])
    parts = (position, ahead, np.array([yaw, pitch, roll]))
    orbit, velocity, angles = (polynomial(0.0, 1.0, one[:, None]) for one in parts)
    (found,) = Rotation.from_quat(orbital_attitude(orbit, velocity, angles)(np.zeros(1))).as_matrix()
    down = -position / np.linalg.norm(position)
    forwards = ahead - (ahead @ down) * down
    forwards /= np.linalg.norm(forwards)
    level = np.column_stack([forwards, np.cross(down, forwards), down])
    expected = level @ about(1, -pitch) @ about(0, -roll) @ about(2, -yaw)
    np.testing.assert_allclose(found, expected, atol=1e-9)
