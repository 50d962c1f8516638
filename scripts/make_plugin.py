"""Write the QGIS plugin as a zip that QGIS installs: `make_plugin.py build/amers-qgis.zip`."""

import sys
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from amers.services.formats.vector.qgis_styles import LAYER_STYLES, as_qml

ROOT = Path(__file__).parents[1]
PLUGIN = ROOT / "qgis_plugin" / "amers"
FIRST_TIME = (1980, 1, 1, 0, 0, 0)
"""The time of every member: equal contents make equal zip files."""
READABLE = 0o644 << 16


def write_plugin(path: Path) -> None:
    """Write the plugin with its licence and the style of points into a zip file."""
    members = {file.name: file.read_bytes() for file in PLUGIN.iterdir() if file.is_file()}
    members["LICENSE"] = (ROOT / "LICENSE").read_bytes()
    members["points.qml"] = as_qml(LAYER_STYLES["points"][0]).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    with ZipFile(path, "w") as archive:
        for name, content in sorted(members.items()):
            member = ZipInfo(f"{PLUGIN.name}/{name}", FIRST_TIME)
            member.external_attr, member.compress_type = READABLE, ZIP_DEFLATED
            archive.writestr(member, content)


if __name__ == "__main__":
    write_plugin(Path(sys.argv[1]))
