"""QGIS plugin of Amers: points of a service, and registration of the active raster on them."""


def classFactory(iface):
    """The plugin, as QGIS asks for it.

    Args:
        iface: the QgisInterface of the running QGIS.
    """
    from .plugin import AmersPlugin

    return AmersPlugin(iface)
