"""The least squares of a block in Ceres, with residuals called in Python."""

import time
from typing import Any

import numpy as np
import pyceres

from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.block_solution import State
from amers.services.adjustment.parameters import BlockPriors, ImageParameters
from amers.services.geodesy import move_metres
from amers.services.types import Array


class _Ray(pyceres.CostFunction):  # type: ignore[misc]
    """An observation: a function of the parameters of its image and of its point's step in metres."""

    def __init__(
        self, image: ImageParameters, start: Array, line_sample: Array, sigma_px: float
    ) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([len(image.sigma), 3])
        self.image, self.start = image, start[None]
        self.line_sample, self.sigma_px = line_sample, sigma_px

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
        """Fill in what Ceres asks for."""
        ground = move_metres(self.start, np.asarray(parameters[1])[None])
        computed = self.image.model.project(ground)
        design = self.image.design(computed)[0]
        off = self.line_sample - computed[0] - design @ parameters[0]
        residuals[:] = off / self.sigma_px
        if jacobians is not None:
            if jacobians[0] is not None:
                jacobians[0][:] = (-design / self.sigma_px).ravel()
            if jacobians[1] is not None:
                jacobians[1][:] = (
                    -self.image.model.project_derivative(ground)[0] / self.sigma_px
                ).ravel()
        return True


class _Prior(pyceres.CostFunction):  # type: ignore[misc]
    """What is known of the parameters of an image."""

    def __init__(self, root: Array) -> None:
        super().__init__()
        self.set_num_residuals(len(root))
        self.set_parameter_block_sizes([len(root)])
        self.root = root

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
        """Fill in what Ceres asks for."""
        residuals[:] = self.root * parameters[0]
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = np.diag(self.root).ravel()
        return True


def solved_by_ceres(problem: BlockProblem, priors: BlockPriors, start: State) -> dict[str, Any]:
    """Cost and times of Ceres' solution of a problem without control."""
    ceres = pyceres.Problem()
    values = [np.zeros(priors.size) for _ in problem.images]
    seen = np.unique(problem.observations.point)
    steps = {int(point): np.zeros(3) for point in seen}
    root = np.sqrt(priors.shape + priors.locating.diagonal()).reshape(-1, priors.size)
    costs = []
    observations = problem.observations
    rows = zip(
        observations.point.tolist(),
        observations.image.tolist(),
        observations.line_sample,
        observations.sigma_px.tolist(),
        strict=True,
    )
    for point, image, line_sample, sigma_px in rows:
        ray = _Ray(problem.images[image], start.lon_lat_h[point], line_sample, sigma_px)
        costs.append(ray)
        ceres.add_residual_block(ray, None, [values[image], steps[point]])
    for own, at in zip(root, values, strict=True):
        costs.append(_Prior(own))
        ceres.add_residual_block(costs[-1], None, [at])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.num_threads = 1
    options.max_num_iterations = 100
    options.function_tolerance = 1e-10
    options.minimizer_progress_to_stdout = False
    summary = pyceres.SolverSummary()
    begun = time.process_time()
    pyceres.solve(options, ceres, summary)
    return {
        "cost": float(summary.final_cost),
        "cpu_s": time.process_time() - begun,
        "linear_solver_s": float(summary.linear_solver_time_in_seconds),
        "iterations": int(summary.num_successful_steps),
        "report": str(summary.BriefReport()),
    }
