"""Reports of registrations whose truth is known."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.quality.accuracy import accuracy
from amers.services.quality.qualification import QualificationOptions, qualify
from amers.services.registration.context import SearchStage
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.build import build_report
from amers.services.reports.figure_data import ChipComparison, FigureData, Quicklook
from amers.services.reports.report import (
    BlockUsed,
    Check,
    RefinedModelRecord,
    RegistrationReport,
    RunRecord,
    SceneRecord,
)
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Acquisition, FloatImage, Frame, Measures, ViewMeasures
from tests.services.conftest import FlatModel, register

FRAME = Frame.from_sigmas(1.5, 2.5)


@dataclass(frozen=True)
class Material:
    """What a report is built from."""

    registration: Registration
    scene: SceneRecord
    run: RunRecord
    refined_model: RefinedModelRecord
    figure_data: FigureData
    checks: tuple[Check, ...]

    @property
    def measures(self) -> Measures:
        return self.registration.measures

    def report(self) -> RegistrationReport:
        return build_report(
            self.registration,
            self.scene,
            self.run,
            self.refined_model,
            self.figure_data,
            checks=self.checks,
        )

    def with_measures(self, measures: Measures) -> "Material":
        """The same with other measures, under the same qualification."""
        return replace(
            self,
            registration=replace(self.registration, measures=measures),
            figure_data=replace(self.figure_data, measures=measures),
        )


def landscape(shape: tuple[int, int], seed: int) -> FloatImage:
    """Smooth random ground."""
    rng = np.random.default_rng(seed)
    image = np.zeros(shape)
    for scale in (4, 16, 48):
        coarse = rng.normal(size=(shape[0] // scale + 2, shape[1] // scale + 2))
        image += np.kron(coarse, np.ones((scale, scale)))[: shape[0], : shape[1]] * np.sqrt(scale)
    return (600.0 + 40.0 * image).astype(np.float32)


def chip_comparison(k: int) -> ChipComparison:
    """A chip and the same ground in another light, two pixels aside before the registration."""
    chip = landscape((101, 101), seed=k)
    noise = np.random.default_rng(k).normal(0.0, 4.0 * k, (101, 101))
    registered = (1.4 * chip + noise).astype(np.float32)
    return ChipComparison(
        point_id=k,
        gsd_m=0.5,
        chip=np.clip(chip, 1, 4000).astype(np.uint16),
        raw=np.roll(registered, 2, axis=1),
        registered=registered,
        score=0.98 - 0.02 * k,
        residual_px=np.array([0.1, -0.2]) if k < 12 else np.full(2, np.nan),
        status="active" if k < 12 else "score under 0.8",
    )


def material_of(
    name: str = "IMG_PHR1A_201201", compared: int = 16, frame: Frame = FRAME, **of_registration
) -> Material:
    """What a report is built from; takes what `register` takes, and a name."""
    scene = replace(register(**of_registration), frame=frame)
    lines, samples = scene.shape
    corner = np.array([samples, -lines]) * scene.gsd_m / 111_320.0
    rng = np.random.default_rng(1)
    none = np.empty(0, dtype=np.int64)
    registration = Registration(
        model=CorrectedModel(FlatModel(), scene.adjustment.correction),
        adjustment=scene.adjustment,
        measures=scene.measures,
        views=ViewMeasures(none, none, np.empty(0), none.astype(bool), none.astype(str)),
        search_stages=(
            SearchStage("coarse", 2.0, 60.0, 56.0, 50, 44, 2, 41, 31.0),
            SearchStage("fine", 0.5, 6.0, 5.0, len(scene.measures.score), 52, 0, 48, 0.4),
        ),
        frame=scene.frame,
        qualification=qualify(scene.adjusted(), QualificationOptions(), rng),
    )
    return Material(
        registration=registration,
        scene=SceneRecord(
            name=name,
            acquisition=Acquisition(
                "IMG_1", "PHR1A", datetime(2012, 1, 5, 10, 42, tzinfo=UTC), 12.3, 190.0, 24.5, 165.0
            ),
            lines=lines,
            samples=samples,
            gsd_m=scene.gsd_m,
            model="RPC",
            sigma_m=10.0,
            footprint_lon_lat=np.array([[0.0, 0.0], [0.0, corner[1]], corner, [corner[0], 0.0]]),
        ),
        run=RunRecord(
            software_version="0.1.0",
            started_at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
            finished_at=datetime(2026, 1, 2, 3, 5, 5, tzinfo=UTC),
            method="control points",
            blocks=(BlockUsed("calanques", "1"),),
            options=RegistrationOptions(),
        ),
        refined_model=RefinedModelRecord(0.0004, "refined_RPC.TXT carries the correction"),
        figure_data=FigureData(
            measures=scene.measures,
            quicklook=Quicklook(landscape((400, 500), seed=9), 10.0),
            gallery=tuple(chip_comparison(k) for k in range(compared)),
        ),
        checks=(Check("simulated truth", accuracy(np.random.default_rng(4).normal(0, 0.1, (25, 2)))),),
    )


@pytest.fixture
def material() -> Callable[..., Material]:
    """Makes what a report is built from."""
    return material_of


@pytest.fixture
def report() -> RegistrationReport:
    """The report of a clean registration."""
    return material_of().report()
