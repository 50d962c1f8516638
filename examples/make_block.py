"""Make a block of control points from overlapping images.

    python examples/make_block.py FOLDER [IMAGE IMAGE ...]

Without images of your own, the example simulates three. It writes the block into FOLDER/block and draws
the chips of some of its points into FOLDER/chips.png.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import simulated_images

from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.production.image_production import ProductionOptions
from amers.services.types import point_chips


def make_block(images: list[Path], folder: Path) -> None:
    """Make points from images, write them as a block folder, and print how well the images agree."""
    # Chips are 101 pixels wide: at 1 m and 4 m per pixel they show 101 m and 404 m of ground.
    options = ProductionOptions(fine_gsd_m=1.0, coarse_gsd_m=4.0, points=60)
    identity = BlockIdentity("example", title="A block of the examples", license="CC0-1.0")

    # `sigma_m` states how wrong the models of the images may be: one standard deviation per coordinate.
    production = run_image_production(
        ProductionImages(tuple(images), sigma_m=3.0), folder, identity, options
    )

    accuracy = production.relative_accuracy
    print(f"{len(production.points)} points in {folder}")
    print(f"median distance between rays and tie points: {accuracy.before_px:.2f} px as delivered,")
    print(f"{accuracy.after_px:.2f} px after the adjustment of the images")
    frame = accuracy.frame
    print(f"frame of the block on the Earth: {frame.sigma_m:.1f} m, height {frame.sigma_up_m:.1f} m")


def draw_chips(block_folder: Path, picture: Path, count: int = 5) -> None:
    """Draw all chips of the most salient points: one row for each point, one column for each view."""
    points = read_block(block_folder).points
    chips = FolderChips(block_folder)
    rows = points.saliency.argsort()[::-1][:count]
    views = [point_chips(points, chips, row) for row in rows]

    columns = max(len(chips_of_point) for chips_of_point in views)
    figure, axes = plt.subplots(count, columns, figsize=(1.5 * columns, 1.5 * count), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for row, chips_of_point in enumerate(views):
        for column, chip in enumerate(chips_of_point):
            axes[row, column].imshow(chip, cmap="gray")
    figure.savefig(picture, dpi=100, bbox_inches="tight")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    output, *names = map(Path, sys.argv[1:])
    make_block(names or simulated_images.write_block_images(output / "images"), output / "block")
    draw_chips(output / "block", output / "chips.png")
