"""What the commands of `amers production` read and print alike."""

import math
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from amers.app.cli.output import Row
from amers.app.errors import InputError
from amers.services.adjustment.bundle import BlockAdjustment
from amers.services.adjustment.control_ground import ControlGround
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.block import produced_accuracy
from amers.services.tasks import Effort
from amers.services.types import Array, ControlPoints


def agreement_row(shift_m: Array, local_sigma_m: float) -> Row:
    """How the images of a block agree: by which each lay off the first, and their local errors."""
    if len(shift_m) < 2:
        return {}
    return {
        "image_shifts_east_north_m": [[round(v, 2) for v in shift] for shift in shift_m.tolist()],
        "local_sigma_m": None if math.isnan(local_sigma_m) else round(local_sigma_m, 2),
    }


def control_row(control: ControlGround, adjustment: BlockAdjustment) -> Row:
    """How control fits the block: points used, those thrown out by name, and the misfits."""
    if len(control) == 0:
        return {}
    used = adjustment.control_active
    misfit_m = [axis[np.isfinite(axis)] for axis in adjustment.control_misfit_m[used].T]
    return {
        "control_points": len(control),
        "control_points_used": int(used.sum()),
        "control_misfit_east_north_up_m": [
            round(float(np.sqrt(np.mean(axis**2))), 2) if len(axis) else None for axis in misfit_m
        ],
        "control_points_left_out": [
            name for name, is_used in zip(control.names, used, strict=True) if not is_used
        ],
    }


def effort_row(effort: Mapping[str, Effort], *, as_json: bool) -> Row:
    """Seconds of a core that every stage took, and its number of tasks."""
    if as_json:
        return {"effort": {stage: asdict(one) for stage, one in effort.items()}}
    return {"cpu_s": [f"{stage} {one.cpu_s:.0f} ({one.tasks})" for stage, one in effort.items()]}


def accuracy_row(points: ControlPoints, *, as_json: bool) -> Row:
    """The accuracy of new points, as every place states it."""
    stated = produced_accuracy(points)
    return accuracy_document(stated) if as_json else stated.words


def sampling_pair(text: str) -> tuple[float, float]:
    """Two ground samplings, the finer first."""
    try:
        fine_m, coarse_m = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--gsd-m: {text!r} found, FINE,COARSE such as 2,20 expected") from None
    if not 0.0 < fine_m < coarse_m:
        raise InputError(f"--gsd-m: {text!r} found, two lengths in metres with the finer first expected")
    return fine_m, coarse_m
