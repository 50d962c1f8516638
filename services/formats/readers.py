"""All readers of external files, with their treatment of each statement in such a file."""

from amers.services.formats import ground_masks
from amers.services.formats.elevation.rows import TERRAIN_READERS
from amers.services.formats.gcp.rows import POINT_READERS
from amers.services.formats.images import georeference, pixel_rows, scene_rows
from amers.services.formats.reader_rows import Reader
from amers.services.formats.sensor_models import (
    dimap,
    geom,
    product_documents,
    rigorous_model,
    rpc_text,
    worldview_isd,
)
from amers.services.formats.stac import scenes as stac_scenes
from amers.services.formats.vector import map_layers

READERS: tuple[Reader, ...] = (
    *POINT_READERS,
    scene_rows.READER,
    pixel_rows.READER,
    pixel_rows.MASK_READER,
    rpc_text.RPC_TEXT_READER,
    rpc_text.RPB_READER,
    worldview_isd.READER,
    dimap.READER,
    geom.READER,
    product_documents.READER,
    rigorous_model.READER,
    georeference.AUX_READER,
    georeference.WORLD_FILE_READER,
    *TERRAIN_READERS,
    map_layers.READER,
    ground_masks.READER,
    stac_scenes.READER,
)
"""In the order of `docs/inputs.md`."""

OWN_FILES = frozenset(
    {
        "open_surface",
        "parse_block_json",
        "parse_chip_header",
        "parse_correction",
        "parse_correction_accuracy",
        "parse_frame",
        "parse_scene_model",
        "read_adjusted_images",
        "read_archive",
        "read_block",
        "read_chip_file",
        "read_document",
        "read_feature_csv",
        "read_map_tile",
        "read_points",
        "read_reduced",
        "read_runs",
        "read_views",
    }
)
"""Functions that read files of a format which Amers defines, and checks as a whole."""
PARTS = frozenset(
    {
        "load_json",
        "open_dataset",
        "open_image",
        "open_mosaic",
        "open_piece",
        "open_tiles",
        "read_model_file",
        "open_heights",
        "open_pixels",
        "parse_area",
        "parse_bands",
        "parse_columns",
        "parse_crs",
        "parse_field",
        "parse_footprint",
        "parse_imaging_time",
        "parse_item",
        "parse_mask",
        "parse_number",
        "parse_numbers",
        "parse_polygons",
        "parse_xml",
        "read_comments",
        "read_control_points",
        "read_ground_points",
        "read_head",
        "read_marked_ground",
        "read_masks",
        "read_or_missing",
        "read_rpc",
        "read_text",
        "read_tile",
        "read_used_points",
        "open_base_chip",
        "read_base_chips",
    }
)
"""Functions that read a part of a file, or choose its reader; the readers that they serve have rows."""
