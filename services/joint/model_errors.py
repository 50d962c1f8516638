"""Errors of an adjusted rigorous model beyond the covariance of its free terms.

A published set frees some terms of orbit, attitude and focal length; satellites err in the others, too.
And what people take is an RPC that was fitted to the adjusted model, which follows no attitude exactly.
Both are findings, whose harm the stated accuracy includes.
"""

import numpy as np

from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import ComputationError
from amers.services.joint.block import JointBlock, with_parameter_sets
from amers.services.quality.finding import Finding
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import ParameterSet, left_out_of, with_every_term
from amers.services.sensors.refined import RefinedRpc
from amers.services.types import Array

_LEAST_PX = 0.001
"""Harm below this is arithmetic."""
_LINES, _SAMPLES = 65, 9
"""Places at which an RPC is compared with its model: attitudes turn from line to line."""


def with_every_term_free(
    block: JointBlock, options: RegistrationOptions, known: KnownImages | None
) -> JointBlock | None:
    """The block with all terms of its rigorous models free; None without such models, or a solution.

    Args:
        block: adjusted.
        options: of its adjustment.
        known: see `adjust_together`.
    """
    before = known.names if known else ()
    complete: list[ParameterSet | None] = []
    for measured in block.scenes:
        own = measured.scene.parameter_set
        # What was adjusted before keeps its terms.
        complete.append(own if own is None or measured.name in before else with_every_term(own))
    if complete == [measured.scene.parameter_set for measured in block.scenes]:
        return None
    try:
        return with_parameter_sets(block, complete, options, known)
    except ComputationError:
        return None


def of_left_out_terms(block: JointBlock, complete: JointBlock | None, number: int) -> Finding | None:
    """By how much the terms that the set of a scene leaves out move its model where its points lie.

    The difference of both models is what they are off by, and chance: more terms are less certain, by
    the difference of both covariances. Its mean square without that of chance is the harm.
    """
    parameter_set, rows = block.scenes[number].scene.parameter_set, np.flatnonzero(block.active(number))
    if parameter_set is None or complete is None or not len(rows):
        return None
    ground = block.scenes[number].observations().lon_lat_h[rows]
    moved = complete.model(number).project(ground) - block.model(number).project(ground)
    by_chance = _variance(complete, number, ground) - _variance(block, number, ground)
    square = np.mean(moved**2 - np.maximum(by_chance, 0.0), axis=0)
    harm_px = np.sqrt(np.maximum(square, 0.0))
    if not (harm_px > _LEAST_PX).any():
        return None
    return Finding("left_out_terms", harm_px, _words(parameter_set, harm_px))


def _words(parameter_set: ParameterSet, harm_px: Array) -> str:
    terms = ", ".join(left_out_of(parameter_set))
    line_px, sample_px = harm_px.tolist()
    return (
        f"terms that the set {parameter_set.name} leaves out ({terms}) displace the image by "
        f"{line_px:.2f} px in line and {sample_px:.2f} px in sample (root mean square)"
    )


def _variance(block: JointBlock, number: int, ground: Array) -> Array:
    """Variance (n, 2) of where a scene of a block shows ground (n, 3), by its parameters."""
    design = block.images[number].computed(block.values(number), ground).by_parameters
    return np.asarray(np.einsum("nck,kl,ncl->nc", design, block.covariance(number), design))


def of_rpc(
    model: SensorModel, rpc: RefinedRpc, shape: tuple[int, int], heights_m: tuple[float, float]
) -> Finding | None:
    """By how much an RPC misses the model that it was fitted to.

    Args:
        model: adjusted.
        rpc: fitted to it.
        shape: lines and samples of the image.
        heights_m: lowest and highest ground.
    """
    if rpc.model is None:
        return None
    axes = np.linspace(0.0, shape[0] - 1.0, _LINES), np.linspace(0.0, shape[1] - 1.0, _SAMPLES)
    places = np.tile(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), (2, 1))
    ground = model.locate(places, np.repeat(heights_m, len(places) // 2))
    harm_px = np.sqrt(np.mean((rpc.model.project(ground) - places) ** 2, axis=0))
    if not (harm_px > _LEAST_PX).any():
        return None
    words = (
        f"the RPC that is written for the adjusted model misses it by up to {rpc.max_error_px:.2g} px: "
        "no RPC follows this attitude closer"
    )
    return Finding("refined_rpc", harm_px, words)
