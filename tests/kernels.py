"""Compile the functions that tests spend most time to compile, once, before processes of tests start.

Run: python -m tests.kernels
"""

from amers.app.worker.warm_up import warm_up
from amers.services.registration.on_points import register_scene
from amers.services.surface.options import SurfaceOptions
from tests.services.simulated import BLOCK_SIGMA_M, block, spoiled_view
from tests.services.surface.worlds import compared


def compile_kernels() -> None:
    """Simulate views, make a block of them, register a scene on it, and make a surface."""
    warm_up()
    register_scene(spoiled_view().as_scene(10.0 * BLOCK_SIGMA_M), *block())
    compared(("left", "right", "down"), SurfaceOptions())


if __name__ == "__main__":
    compile_kernels()
