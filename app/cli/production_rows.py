"""What the commands of `amers production` read and print alike."""

import math

from app.cli.output import Row
from app.errors import InputError
from services.quality.accuracy_statement import accuracy_document
from services.quality.block import produced_accuracy
from services.types import Array, ControlPoints


def agreement_row(shift_m: Array, local_sigma_m: float) -> Row:
    """How the images of a block agree: by which each lay off the first, and their local errors."""
    if len(shift_m) < 2:
        return {}
    return {
        "image_shifts_east_north_m": [[round(v, 2) for v in shift] for shift in shift_m.tolist()],
        "local_sigma_m": None if math.isnan(local_sigma_m) else round(local_sigma_m, 2),
    }


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
