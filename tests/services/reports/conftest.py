"""Summaries of registrations whose truth is known."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
import pytest

from services.quality.accuracy import accuracy
from services.quality.qualification import QualificationOptions, qualify
from services.registration.search import SearchStage
from services.reports.report import RegistrationReport, build_report
from services.reports.summary import BlockUsed, Check, ChipPair, Quicklook, RegistrationSummary
from services.types import Acquisition, FloatImage


@dataclass(frozen=True)
class Options:
    """Options inside options, as a registration has them."""

    max_views: int = 6
    min_score: float = 0.8
    qualification: QualificationOptions = field(default_factory=QualificationOptions)


def landscape(shape: tuple[int, int], seed: int) -> FloatImage:
    """Smooth random ground."""
    rng = np.random.default_rng(seed)
    image = np.zeros(shape)
    for scale in (4, 16, 48):
        coarse = rng.normal(size=(shape[0] // scale + 2, shape[1] // scale + 2))
        image += np.kron(coarse, np.ones((scale, scale)))[: shape[0], : shape[1]] * np.sqrt(scale)
    return (600.0 + 40.0 * image).astype(np.float32)


def chip_pair(k: int) -> ChipPair:
    """A chip and the same ground in another light."""
    chip = landscape((101, 101), seed=k)
    noise = np.random.default_rng(k).normal(0.0, 4.0 * k, (101, 101))
    return ChipPair(
        point_id=k,
        gsd_m=0.5,
        chip=np.clip(chip, 1, 4000).astype(np.uint16),
        found=(1.4 * chip + noise).astype(np.float32),
        score=0.98 - 0.02 * k,
        residual_px=np.array([0.1, -0.2]) if k < 12 else np.full(2, np.nan),
        status="active" if k < 12 else "score under 0.8",
    )


@pytest.fixture
def summarised(registered) -> Callable[..., RegistrationSummary]:
    """Makes the summary of a registration; takes what `register` takes, and `name`."""

    def make(name: str = "IMG_PHR1A_201201", pairs: int = 16, **of_registration) -> RegistrationSummary:
        scene = registered(**of_registration)
        lines, samples = scene.shape
        corner = np.array([samples, -lines]) * scene.gsd_m / 111_320.0
        return RegistrationSummary(
            scene=name,
            acquisition=Acquisition(
                "IMG_1", "PHR1A", datetime(2012, 1, 5, 10, 42, tzinfo=UTC), 12.3, 190.0, 24.5, 165.0
            ),
            shape=scene.shape,
            gsd_m=scene.gsd_m,
            model_kind="RPC",
            sigma_m=10.0,
            footprint=np.array([[0.0, 0.0], [0.0, corner[1]], corner, [corner[0], 0.0]]),
            blocks=(BlockUsed("calanques", "1"),),
            options=Options(),
            passes=(
                SearchStage("coarse", 2.0, 60.0, 50, 44, 41, 31.0),
                SearchStage("fine", 0.5, 6.0, len(scene.measures.score), 52, 48, 0.4),
            ),
            order_reason="drift: lowest cross-validated residual",
            measures=scene.measures,
            adjustment=scene.adjustment,
            qualification=qualify(
                scene.measures,
                scene.adjustment,
                scene.shape,
                scene.refit,
                scene.gsd_m,
                QualificationOptions(),
                np.random.default_rng(1),
                frame_sigma_m=1.5,
            ),
            quicklook=Quicklook(landscape((400, 500), seed=9), 10.0),
            gallery=tuple(chip_pair(k) for k in range(pairs)),
            refit_error_px=0.0004,
            software_version="0.1.0",
            started_at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
            finished_at=datetime(2026, 1, 2, 3, 5, 5, tzinfo=UTC),
            checks=(
                Check("simulated truth", accuracy(np.random.default_rng(4).normal(0, 0.1, (25, 2)))),
            ),
        )

    return make


@pytest.fixture
def report(summarised) -> RegistrationReport:
    """The report of a clean registration."""
    return build_report(summarised())
