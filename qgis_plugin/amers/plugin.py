"""The plugin: its entries in the menu *Raster*, and the tasks that they start."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

from qgis.core import QgsApplication, QgsMapLayer, QgsProject, QgsRasterLayer, QgsTask
from qgis.PyQt.QtWidgets import QAction, QInputDialog

from .layers import points_layer, registration_layers
from .registration import Canceled, Progress, last_registration, register
from .service import ServiceError
from .settings import ServiceDialog, stored_service

MENU = "Amers"
LARGEST_SIGMA_M = 100_000.0


class AmersPlugin:
    """The plugin in a running QGIS.

    Attributes:
        iface: of QGIS.
        actions: the entries of the menu, by their texts.
        tasks: those that work or wait.
    """

    def __init__(self, iface) -> None:
        self.iface = iface
        self.actions: dict[str, QAction] = {}
        self.tasks: set[QgsTask] = set()

    def initGui(self) -> None:
        """Add the entries to the menu *Raster*."""
        for text, respond in (
            ("Add points", self.add_points),
            ("Register the active raster…", self.ask_and_register),
            ("Load the registration of the active raster", self.load_registration),
            ("Service…", self.set_service),
        ):
            action = QAction(text, self.iface.mainWindow())
            action.triggered.connect(self._with_messages(respond))
            self.iface.addPluginToRasterMenu(MENU, action)
            self.actions[text] = action

    def unload(self) -> None:
        """Remove the entries, and cancel what works."""
        for action in self.actions.values():
            self.iface.removePluginRasterMenu(MENU, action)
        for task in self.tasks:
            task.cancel()

    def set_service(self) -> None:
        """Ask for the address and the token of the service."""
        ServiceDialog(self.iface.mainWindow()).exec_()

    def add_points(self) -> None:
        """Add the points of the service to the project."""
        QgsProject.instance().addMapLayer(points_layer(stored_service()))

    def ask_and_register(self) -> None:
        """Ask for the accuracy of the model of the active raster, and register the raster."""
        image = self._active_image()
        question = f"Accuracy of the model of {image.name}, metres (1 sigma); 0: as the model states"
        sigma_m, accepted = QInputDialog.getDouble(
            self.iface.mainWindow(), MENU, question, 0.0, 0.0, LARGEST_SIGMA_M, 1
        )
        if accepted:
            self.register(image, sigma_m or None)

    def register(self, image: Path, sigma_m: float | None) -> None:
        """Register an image in the background, and load the results when they are there."""
        service = stored_service()
        self._start(
            f"Amers: register {image.name}",
            image,
            lambda progress: register(service, image, sigma_m, progress),
        )

    def load_registration(self) -> None:
        """Load the last registration of the active raster, such as one that QGIS did not wait for."""
        image, service = self._active_image(), stored_service()
        self._start(
            f"Amers: results of {image.name}", image, lambda progress: last_registration(service, image)
        )

    def _active_image(self) -> Path:
        """The file of the active layer.

        Raises:
            ServiceError: it is no raster in a file.
        """
        layer = self.iface.activeLayer()
        if isinstance(layer, QgsRasterLayer) and Path(layer.source()).is_file():
            return Path(layer.source())
        raise ServiceError("Select a raster layer of a file: the image to register")

    def _start(self, description: str, image: Path, work: Callable[[Progress], Path]) -> None:
        """Do some work in the background; load the folder of results that it returns."""

        def run(task: QgsTask) -> Path:
            def progress(percent: float) -> None:
                if task.isCanceled():
                    raise Canceled
                task.setProgress(percent)

            return work(progress)

        def finish(error: Exception | None, folder: Path | None = None) -> None:
            self.tasks.discard(task)
            if folder is not None:
                self._with_messages(lambda: self._load(image, folder))()
            elif not task.isCanceled():
                self._warn(error)

        task = QgsTask.fromFunction(description, run, on_finished=finish)
        self.tasks.add(task)
        QgsApplication.taskManager().addTask(task)

    def _load(self, image: Path, folder: Path) -> None:
        layers = registration_layers(image, folder)
        group = QgsProject.instance().layerTreeRoot().insertGroup(0, f"{image.stem} registered")
        for layer in layers:
            QgsProject.instance().addMapLayer(layer, False)
            group.insertLayer(0, layer)
        self._show(layers[0])
        self.iface.messageBar().pushSuccess(MENU, f"{image.name} is registered; report: {folder}")

    def _show(self, layer: QgsMapLayer) -> None:
        self.iface.setActiveLayer(layer)
        self.iface.zoomToActiveLayer()

    def _with_messages(self, respond: Callable[[], None]) -> Callable[..., None]:
        """A response to a menu that shows a ServiceError in the message bar."""

        def respond_or_warn(*_: object) -> None:
            try:
                respond()
            except (ServiceError, OSError) as error:
                self._warn(error)

        return respond_or_warn

    def _warn(self, error: Exception | None) -> None:
        self.iface.messageBar().pushWarning(MENU, str(error))
