"""What a user does in QGIS; runs inside QGIS (`qgis --code`) with the Python of the distribution.

The variable AMERS_QGIS_STEP has the name of a function below, its arguments and the file that receives
its result, as JSON.
"""

import json
import os
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsApplication,
    QgsAuthMethodConfig,
    QgsCoordinateReferenceSystem,
    QgsDataSourceUri,
    QgsMapLayer,
    QgsProject,
    QgsRasterLayer,
    QgsRenderContext,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QTimer
from qgis.PyQt.QtWidgets import QApplication, QDialog, QInputDialog
from qgis.utils import iface, plugins

patience_s = 120.0


def store_token(secret: str) -> str:
    """The id of a new authentication configuration of the method Basic, the token as password."""
    manager = QgsApplication.authManager()
    if not manager.masterPasswordIsSet():
        assert manager.setMasterPassword("of the tests", True)
    configuration = QgsAuthMethodConfig("Basic")
    configuration.setName("Amers")
    configuration.setConfig("username", "qgis")
    configuration.setConfig("password", secret)
    assert manager.storeAuthenticationConfig(configuration)
    return str(configuration.id())


def connect(url: str, typename: str, **credentials: str) -> QgsVectorLayer:
    """A layer of the form *Add WFS / OGC API - Features Layer*."""
    uri = QgsDataSourceUri()
    for name, value in {"url": url, "typename": typename, **credentials}.items():
        uri.setParam(name, value)
    return QgsVectorLayer(uri.uri(False), typename, "OAPIF")


def described(layer: QgsMapLayer) -> dict[str, Any]:
    extent = layer.extent()
    return {
        "name": layer.name(),
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "extent": [extent.xMinimum(), extent.yMinimum(), extent.xMaximum(), extent.yMaximum()],
        **(classes_of(layer) if isinstance(layer, QgsVectorLayer) else {}),
    }


def classes_of(layer: QgsVectorLayer) -> dict[str, Any]:
    """The number of features of a layer, the kind and the classes of its renderer, and what it draws."""
    renderer = layer.renderer()
    classes = []
    if renderer.type() == "graduatedSymbol":
        classes = [[item.label(), item.symbol().color().name()] for item in renderer.ranges()]
    if renderer.type() == "categorizedSymbol":
        classes = [[item.value(), item.symbol().color().name()] for item in renderer.categories()]
    return {
        "features": len(list(layer.getFeatures())),
        "renderer": renderer.type(),
        "attribute": getattr(renderer, "classAttribute", str)(),
        "classes": classes,
        "drawn": renderer.symbols(QgsRenderContext())[0].symbolLayer(0).layerType(),
    }


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, "QGIS did not get there in time"
        QApplication.processEvents()
        time.sleep(0.05)


def take_picture(path: str) -> None:
    """The window as it is when the map has been drawn."""
    canvas = iface.mapCanvas()
    canvas.refreshAllLayers()
    QApplication.processEvents()
    wait_until(lambda: not canvas.isDrawing())
    assert iface.mainWindow().grab().save(path)


def answer(respond: Callable[[QDialog], None]) -> None:
    """Respond to the dialog that opens next."""

    def look() -> None:
        dialog = QApplication.activeModalWidget()
        if dialog is None:
            QTimer.singleShot(50, look)
        else:
            respond(dialog)

    QTimer.singleShot(50, look)


def choose(text: str) -> None:
    """Choose an entry of the menu of the plugin, and wait for what it does."""
    plugin = plugins["amers"]
    plugin.actions[text].trigger()
    wait_until(lambda: not plugin.tasks)


def set_service(url: str, authcfg: str) -> None:
    """Fill in the form of the plugin."""

    def fill(dialog: QDialog) -> None:
        dialog.address.setText(url)
        dialog.authentication.setConfigId(authcfg)
        dialog.accept()

    answer(fill)
    choose("Service…")


def register_with(sigma_m: float) -> None:
    """Register the active raster with an accuracy of its model, metres."""

    def fill(dialog: QInputDialog) -> None:
        dialog.setDoubleValue(sigma_m)
        dialog.accept()

    answer(fill)
    choose("Register the active raster…")


def messages() -> list[str]:
    """What the message bar shows of the plugin, the newest first."""
    return [item.text() for item in iface.messageBar().items() if item.title() == "Amers"]


def layers_with_a_token(url: str, secret: str) -> dict[str, Any]:
    authcfg = store_token(secret)
    by_password = {"username": "qgis", "password": secret}
    return {
        "points by authcfg": described(connect(url, "points", authcfg=authcfg)),
        "points by password": described(connect(url, "points", **by_password)),
        "blocks by authcfg": described(connect(url, "blocks", authcfg=authcfg)),
        "blocks by password": described(connect(url, "blocks", **by_password)),
    }


def layer_with_a_wrong_token(url: str) -> dict[str, Any]:
    """QGIS asks for a user name and a password; its user cancels."""
    dialogs = []

    def cancel(dialog: QDialog) -> None:
        dialogs.append(dialog.windowTitle())
        answer(cancel)
        dialog.reject()

    answer(cancel)
    layer = connect(url, "points", authcfg=store_token("wrong"))
    return {"valid": layer.isValid(), "asked": bool(dialogs)}


def styles_of_a_geopackage(path: str) -> dict[str, Any]:
    layer = QgsVectorLayer(path, "points", "ogr")
    _, _, names, _, error = layer.listStylesInDatabase()
    return {**described(layer), "styles": names, "error": error}


def round_trip(url: str, secret: str, image: str, sigma_m: float, pictures: str) -> dict[str, Any]:
    QgsProject.instance().setCrs(QgsCoordinateReferenceSystem("EPSG:4326"))
    set_service(url, store_token(secret))
    choose("Add points")
    (points,) = QgsProject.instance().mapLayers().values()
    iface.setActiveLayer(points)
    iface.zoomToActiveLayer()
    take_picture(f"{pictures}/qgis_points.png")
    raster = QgsProject.instance().addMapLayer(QgsRasterLayer(image, "raw scene"))
    iface.setActiveLayer(raster)
    register_with(sigma_m)
    QgsProject.instance().layerTreeRoot().findLayer(raster).setItemVisibilityChecked(False)
    take_picture(f"{pictures}/qgis_registered.png")
    group = QgsProject.instance().layerTreeRoot().findGroups()[0]
    loaded = {node.layer().name(): described(node.layer()) for node in group.findLayers()}
    return {"points": described(points), "loaded": loaded, "messages": messages()}


def load_again(url: str, secret: str, image: str) -> dict[str, Any]:
    set_service(url, store_token(secret))
    iface.setActiveLayer(QgsProject.instance().addMapLayer(QgsRasterLayer(image, "raw scene")))
    choose("Load the registration of the active raster")
    groups = QgsProject.instance().layerTreeRoot().findGroups()
    loaded = [node.layer().name() for group in groups for node in group.findLayers()]
    return {"loaded": loaded, "messages": messages()}


def register_and_load(url: str, secret: str, image: str, sigma_m: float) -> dict[str, Any]:
    set_service(url, store_token(secret))
    iface.setActiveLayer(QgsProject.instance().addMapLayer(QgsRasterLayer(image, "raw scene")))
    register_with(sigma_m)
    groups = QgsProject.instance().layerTreeRoot().findGroups()
    loaded = [node.layer().name() for group in groups for node in group.findLayers()]
    return {"loaded": loaded, "messages": messages()}


def cancel_a_registration(url: str, secret: str, image: str) -> dict[str, Any]:
    set_service(url, store_token(secret))
    plugin = plugins["amers"]
    plugin.register(Path(image), None)
    (task,) = plugin.tasks
    wait_until(lambda: task.progress() > 0)
    task.cancel()
    wait_until(lambda: not plugin.tasks)
    return {"messages": messages(), "layers": len(QgsProject.instance().mapLayers())}


def sentences_of_errors(url: str, secret: str, closed: str, image: str, text: str) -> dict[str, Any]:
    """The newest message after each thing that goes wrong."""
    authcfg, wrong = store_token(secret), store_token("wrong")
    said = {}

    def note(what: str) -> None:
        said[what] = messages()[0]
        iface.messageBar().clearWidgets()

    choose("Add points")
    note("no service")
    set_service(url, authcfg)
    choose("Load the registration of the active raster")
    note("no raster")
    iface.setActiveLayer(QgsProject.instance().addMapLayer(QgsRasterLayer(text, "text")))
    register_with(5.0)
    note("no image")
    iface.setActiveLayer(QgsProject.instance().addMapLayer(QgsRasterLayer(image, "raw scene")))
    choose("Load the registration of the active raster")
    note("never sent")
    register_with(0.0)
    note("no model")
    set_service(url, wrong)
    register_with(5.0)
    note("wrong token")
    set_service(closed, authcfg)
    register_with(5.0)
    note("no answer")
    return said


def run_step() -> None:
    """Run the step, write its result, and end QGIS."""
    step = json.loads(os.environ["AMERS_QGIS_STEP"])
    try:
        outcome = {"result": globals()[step["name"]](**step["arguments"])}
    except BaseException:
        outcome = {"error": traceback.format_exc()}
    Path(step["outcome"]).write_text(json.dumps(outcome))
    os._exit(0)


QTimer.singleShot(0, run_step)
