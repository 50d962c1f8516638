"""The correction of a sensor model as a JSON document, which every registration writes.

With `t = ((line, sample) - centre) / half_size`, a position of the delivered model moves by
`parameters (1, t_line, t_sample)`. The centre of the first pixel is (0, 0).
"""

import json
import math
from typing import Any

import numpy as np

from services.errors import FormatError
from services.formats.text_files import load_json
from services.sensors.correction import ImageCorrection
from services.types import Array

CORRECTION_FORMAT = "amers-image-correction/1"


def format_correction(
    correction: ImageCorrection,
    order: str,
    covariance_px2: Array,
    local_sigma_px: Array,
    *,
    applies_to: str,
    carried: str,
) -> str:
    """The JSON document of a correction.

    Args:
        correction: from positions of the delivered model to true positions.
        order: "shift", "drift" or "affine".
        covariance_px2: (6, 6) covariance of the parameters, row by row.
        local_sigma_px: (2,) line and sample, of what parts of the image are off by beyond it.
        applies_to: one sentence on the origin of the delivered model.
        carried: one sentence on the files that contain the correction, and their accuracy.
    """
    document = {
        "format": CORRECTION_FORMAT,
        "applies_to": applies_to,
        "carried": carried,
        "pixel_origin": "the centre of the first pixel is line 0, sample 0",
        "formula": "(line, sample) + parameters_px (1, t_line, t_sample), "
        "t = ((line, sample) - centre_px) / half_size_px",
        "order": order,
        "parameters_px": correction.parameters.tolist(),
        "centre_px": correction.centre.tolist(),
        "half_size_px": correction.half_size.tolist(),
        "covariance_px2": [
            [v if math.isfinite(v) else None for v in row] for row in covariance_px2.tolist()
        ],
        "local_sigma_px": local_sigma_px.tolist(),
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def parse_correction(text: str, source: str = "correction") -> ImageCorrection:
    """The correction of a JSON document.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the document has another form, or its correction folds or mirrors the image.
    """
    document = load_json(text, source)
    if not isinstance(document, dict) or document.get("format") != CORRECTION_FORMAT:
        raise FormatError(f"{source}: expected a document of the format {CORRECTION_FORMAT}")
    correction = ImageCorrection(
        parameters=_numbers(document, "parameters_px", (2, 3), source),
        centre=_numbers(document, "centre_px", (2,), source),
        half_size=_numbers(document, "half_size_px", (2,), source),
    )
    if not (correction.half_size > 0.0).all():
        raise FormatError(f"{source}: half_size_px: expected positive numbers")
    if not np.linalg.det(correction.jacobian) > 0.0:
        raise FormatError(
            f"{source}: parameters_px: expected a correction that neither folds nor mirrors the image"
        )
    return correction


def _numbers(document: dict[str, Any], name: str, shape: tuple[int, ...], source: str) -> Array:
    try:
        values = np.array(document.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != shape or not np.isfinite(values).all():
        expected = " x ".join(map(str, shape))
        raise FormatError(f"{source}: {name}: expected {expected} finite numbers")
    return values
