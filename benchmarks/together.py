"""The published blocks of scenes in simulation: Marrakech and Nigeria, in the published columns.

Marrakech: eleven images like those of Pleiades in three passes, 237 control points. Nigeria: seven like
those of SPOT 6/7, three of them hazy as published. Images have no pixels: control points and tie points
are measured with noise and blunders in true images, and models are delivered with errors. Published
figures stand beside (Space Reference Points on Africa, 2021, tables 2 to 7). Marrakech is repeated with
one image bent by 3 m, which has to leave by name.
Run: python -m benchmarks.together [--blocks marrakech,wrong,nigeria]
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from amers.services.imagery.scene import scene_gsd_m
from amers.services.joint.block import JointBlock
from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.registration import qualified
from amers.services.joint.results import ground_misfits_m
from amers.services.quality.stability import image_places
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import CorrectedModel
from amers.services.simulation.world import make_world
from amers.services.types import Array, Frame
from benchmarks._joint_scenes import (
    ImagePlan,
    JointTruth,
    errors_px,
    image_truth,
    joint_truth,
    measured_scene,
    places,
    tie_points,
)
from benchmarks._measuring import keep, print_table

OPTIONS = RegistrationOptions(max_points=0)
RELIEF_M = 60.0
BENT = "2: 32.2"


@dataclass(frozen=True)
class Published:
    """What is published of one image: tables 2 or 4, and 3 or 5, metres.

    Attributes:
        visible, matched, active: Popini, Spatio, Actif.
        residual_m: length of the mean residual in the image, and of the standard deviations.
        ground_m: standard deviations of ground residuals, x, y, Z.
    """

    visible: int
    matched: int
    active: int
    residual_m: tuple[float, float]
    ground_m: tuple[float, float, float]


MARRAKECH = {
    "1: 31.2": Published(227, 167, 163, (0.1, 1.4), (0.4, 0.3, 1.39)),
    "1: 30.1": Published(205, 157, 152, (0.2, 1.3), (0.4, 0.3, 1.48)),
    "2: 32.2": Published(229, 177, 173, (0.2, 1.1), (0.4, 0.3, 1.42)),
    "2: 27.5": Published(157, 117, 113, (3.2, 3.9), (0.4, 0.4, 1.16)),
    "2: 11.5": Published(128, 102, 99, (0.1, 1.3), (0.4, 0.4, 1.66)),
    "2: 1.5": Published(142, 121, 119, (0.1, 0.8), (0.4, 0.3, 1.63)),
    "2: 11.7": Published(145, 127, 122, (0.3, 1.4), (0.4, 0.3, 1.62)),
    "2: 27.1": Published(128, 102, 91, (1.8, 3.4), (0.4, 0.4, 1.71)),
    "3: 31.0": Published(206, 168, 165, (0.1, 1.0), (0.4, 0.3, 1.41)),
    "3: 29.0": Published(190, 158, 155, (0.1, 1.1), (0.3, 0.3, 1.49)),
    "3: 30.1": Published(225, 184, 178, (0.1, 1.2), (0.3, 0.3, 1.42)),
}
"""By pass and incidence."""
NIGERIA = {
    "2017-02-18 hazy": Published(997, 526, 494, (0.1, 1.2), (0.2, 0.1, 1.27)),
    "2017-01-04": Published(1779, 1462, 1444, (0.0, 0.8), (0.1, 0.1, 0.40)),
    "2018-12-27 a": Published(968, 822, 800, (0.0, 0.9), (0.2, 0.1, 1.01)),
    "2018-12-27 b": Published(537, 495, 476, (0.1, 1.4), (0.2, 0.1, 0.72)),
    "2018-01-02 hazy": Published(1020, 305, 302, (0.1, 1.4), (0.2, 0.1, 1.55)),
    "2017-02-19 hazy": Published(606, 323, 281, (0.1, 1.4), (0.3, 0.1, 0.78)),
    "2017-01-03": Published(1952, 1833, 1805, (0.0, 0.8), (0.1, 0.1, 0.56)),
}


@dataclass(frozen=True)
class Row:
    """One image of a simulated block: the published columns, and what only a simulation knows.

    Attributes:
        name: of the image.
        visible, matched, active: control points.
        mean_m, std_m: image residuals, lengths of both coordinates.
        ground_std_m: of the ground residuals: east, north, up.
        moved_m: largest displacement of corners and centre with 80 % of the points, first draw.
        held_mean_m, held_std_m: residuals of the points held out.
        verdict: on the image.
        ce90_m: stated relative to the control points, at the worst place.
        error_m: true error relative to the control points, worst of corners and centre.
        earth_error_m: on the Earth.
        alone_error_m: relative to the control points, of the image registered alone; NaN without.
    """

    name: str
    visible: int
    matched: int
    active: int
    mean_m: float
    std_m: float
    ground_std_m: tuple[float, ...]
    moved_m: float
    held_mean_m: float
    held_std_m: float
    verdict: str
    ce90_m: float
    error_m: float
    earth_error_m: float
    alone_error_m: float


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", default="marrakech,wrong,nigeria", help="some of %(default)s")
    kept = {}
    for name in parser.parse_args().blocks.split(","):
        rng = np.random.default_rng([13, len(name)])
        published = NIGERIA if name == "nigeria" else MARRAKECH
        truth, extent_m = nigeria(rng) if name == "nigeria" else marrakech(rng, bent=name == "wrong")
        begun = time.process_time()
        rows, left = measure(truth, extent_m, rng)
        show(name, rows, left, published, time.process_time() - begun)
        kept[name] = {"images": [asdict(row) for row in rows], "left": left}
    keep("together", kept)


def measure(truth: JointTruth, extent_m: Array, rng: np.random.Generator) -> tuple[list[Row], list[str]]:
    """The images of a block registered together, and why others have left."""
    scenes = [measured_scene(truth, number, rng, OPTIONS) for number in range(len(truth.images))]
    origin = np.append(truth.true_lon_lat_h[:, :2].mean(axis=0), 150.0)
    ties = tie_points(truth.images, places(rng, origin, extent_m, 4000, RELIEF_M), rng, seen=0.5)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    numbers = range(len(block.scenes))
    names = [image.plan.name for image in truth.images]
    rows = [
        _row(truth, names.index(block.scenes[k].name), block, k, registration)
        for k, registration in zip(numbers, qualified(block, numbers, OPTIONS), strict=True)
    ]
    return rows, [str(one.error) for one in left]


def _row(truth: JointTruth, number: int, block: JointBlock, k: int, registration: Registration) -> Row:
    quality, measured = registration.qualification, block.scenes[k]
    gsd_m, counts = scene_gsd_m(measured.scene), quality.point_counts
    x, y = quality.image_residuals_px.x, quality.image_residuals_px.y
    held = quality.stability.held_out_m
    at = image_places(measured.scene.image.shape)
    relative, earth = errors_px(truth, number, registration.model, at)
    alone_m = float("nan")
    if measured.alone is not None:
        own = CorrectedModel(measured.scene.model, measured.alone.correction)
        alone_m = float(np.hypot(*errors_px(truth, number, own, at)[0].T).max() * gsd_m)
    return Row(
        name=measured.name,
        visible=counts.visible,
        matched=counts.matched,
        active=counts.active,
        mean_m=float(np.hypot(x.mean, y.mean) * gsd_m),
        std_m=float(np.hypot(x.std, y.std) * gsd_m),
        ground_std_m=tuple(ground_misfits_m(block, k).std(axis=0, ddof=1).tolist()),
        moved_m=max(np.hypot(place.x_m, place.y_m) for place in quality.stability.displacements),
        held_mean_m=float(np.hypot(held.x.mean, held.y.mean)),
        held_std_m=float(np.hypot(held.x.std, held.y.std)),
        verdict=quality.verdict,
        ce90_m=quality.predicted.worst_m,
        error_m=float(np.hypot(*relative.T).max() * gsd_m),
        earth_error_m=float(np.hypot(*earth.T).max() * gsd_m),
        alone_error_m=alone_m,
    )


def marrakech(rng: np.random.Generator, *, bent: bool) -> tuple[JointTruth, Array]:
    """Eleven images of 20 km at 0.5 m in three passes, and 237 points of 23 x 23 km."""
    extent_m = np.array([-11500.0, 11500.0, -11500.0, 11500.0])
    azimuth_deg = {"1": 75.0, "2": 10.0, "3": 285.0}
    plans = []
    for count, (name, published) in enumerate(MARRAKECH.items()):
        of_pass, incidence = name.split(": ")
        behind = of_pass == "2" and count > 5
        side = float(np.sqrt(published.visible / 237.0) * 23000.0)
        size = round(min(side, 20000.0) / 0.5)
        plans.append(
            ImagePlan(
                name,
                tuple(rng.uniform(-1.0, 1.0, 2) * (11500.0 - size * 0.25)),
                float(incidence),
                azimuth_deg[of_pass] + (180.0 if behind else 25.0 * (count % 3)),
                (size, size),
                0.5,
                sigma_m=4.0,
                bend_px=(6.0, 4.0) if bent and name == BENT else (0.3, 0.3),
                control_noise_px=1.2,
                tie_noise_px=0.35,
                found=published.matched / published.visible,
                wrong=0.04,
                acquired_at=datetime(2019, 8, 4 + 2 * int(of_pass), 11, tzinfo=UTC)
                + timedelta(seconds=20 * count),
            )
        )
    return _block(plans, 237, extent_m, rng), extent_m


def nigeria(rng: np.random.Generator) -> tuple[JointTruth, Array]:
    """Seven images of up to 60 km at 1.5 m side by side, and 2,600 points; haze hides most of some."""
    extent_m = np.array([-72000.0, 72000.0, -30000.0, 30000.0])
    plans = []
    for count, (name, published) in enumerate(NIGERIA.items()):
        width_m = 144000.0 * published.visible / 2600.0
        size = round(min(float(np.sqrt(width_m * 60000.0)), 60000.0) / 1.5)
        plans.append(
            ImagePlan(
                name,
                (-54000.0 + 18000.0 * count, float(rng.uniform(-4000.0, 4000.0))),
                float(rng.uniform(3.0, 20.0)),
                float(rng.choice([95.0, 275.0])),
                (size, size),
                1.5,
                sigma_m=4.7,
                bend_px=(0.1, 0.1),
                control_noise_px=0.4,
                tie_noise_px=0.3,
                found=published.matched / published.visible,
                wrong=0.03,
                acquired_at=datetime(2018, 1, 1, 10, tzinfo=UTC) + timedelta(days=30 * count),
            )
        )
    return _block(plans, 2600, extent_m, rng), extent_m


def _block(
    plans: Sequence[ImagePlan], points: int, extent_m: Array, rng: np.random.Generator
) -> JointTruth:
    world = make_world(np.random.default_rng(1), size_m=1000.0, posting_m=2.0)
    origin = np.append(world.centre_lon_lat, 150.0)
    images = [image_truth(plan, world, origin, rng) for plan in plans]
    ground = places(rng, origin, extent_m, points, RELIEF_M)
    frame = Frame.from_sigmas(1.4, 2.5)
    return joint_truth(images, ground, rng, sigma_m=0.5, sigma_up_m=1.5, frame=frame)


def show(
    name: str, rows: Sequence[Row], left: Sequence[str], published: dict[str, Published], cpu_s: float
) -> None:
    """Print the tables of one block: ours / published."""
    columns: dict[str, Callable[[Row], object]] = {
        "image": lambda row: row.name,
        "visible": lambda row: f"{row.visible} / {published[row.name].visible}",
        "matched": lambda row: f"{row.matched} / {published[row.name].matched}",
        "active": lambda row: f"{row.active} / {published[row.name].active}",
        "residual mean": lambda row: f"{row.mean_m:.2f} / {published[row.name].residual_m[0]:.1f}",
        "std": lambda row: f"{row.std_m:.2f} / {published[row.name].residual_m[1]:.1f}",
        "ground x, y, Z std": lambda row: (
            f"{', '.join(f'{value:.2f}' for value in row.ground_std_m)}"
            f" / {', '.join(map(str, published[row.name].ground_m))}"
        ),
        "80 %: moved": lambda row: f"{row.moved_m:.2f}",
        "held out mean, std": lambda row: f"{row.held_mean_m:.2f}, {row.held_std_m:.2f}",
        "verdict": lambda row: row.verdict,
        "CE90": lambda row: f"{row.ce90_m:.2f}",
        "error": lambda row: f"{row.error_m:.2f}",
        "alone": lambda row: f"{row.alone_error_m:.2f}",
        "Earth": lambda row: f"{row.earth_error_m:.2f}",
    }
    print_table(f"{name}: ours / published, metres; {cpu_s:.0f} s of CPU time", rows, columns, width=200)
    for reason in left:
        print(f"left: {reason}")


if __name__ == "__main__":
    main()
