"""The service that a user works with: its address and the authentication that holds the token."""

from __future__ import annotations

from qgis.core import QgsSettings
from qgis.gui import QgsAuthConfigSelect
from qgis.PyQt.QtWidgets import QDialog, QDialogButtonBox, QFormLayout, QLineEdit, QWidget

from .service import Service, ServiceError

URL, AUTHCFG = "amers/url", "amers/authcfg"


def stored_service() -> Service:
    """The service of the settings.

    Raises:
        ServiceError: no address is set.
    """
    settings = QgsSettings()
    url = settings.value(URL, "")
    if not url:
        raise ServiceError("No service is set: enter its address under Raster, Amers, Service")
    return Service(url, settings.value(AUTHCFG, ""))


class ServiceDialog(QDialog):
    """A form for the address and the authentication of the service; *OK* stores both."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("Amers service")
        settings = QgsSettings()
        self.address = QLineEdit(settings.value(URL, ""))
        self.address.setPlaceholderText("https://gcp.example.org")
        self.address.setMinimumWidth(360)
        self.authentication = QgsAuthConfigSelect(self)
        self.authentication.setConfigId(settings.value(AUTHCFG, ""))
        buttons = QDialogButtonBox(QDialogButtonBox.Ok | QDialogButtonBox.Cancel)
        buttons.accepted.connect(self.accept)
        buttons.rejected.connect(self.reject)
        form = QFormLayout(self)
        form.addRow("Address", self.address)
        form.addRow("Token (as password of Basic)", self.authentication)
        form.addRow(buttons)

    def accept(self) -> None:
        """Store the values and close the form."""
        settings = QgsSettings()
        settings.setValue(URL, self.address.text().strip())
        settings.setValue(AUTHCFG, self.authentication.configId())
        super().accept()
