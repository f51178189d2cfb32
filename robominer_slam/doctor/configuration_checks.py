"""The configuration file: whether it can be read, and whether what it says of network, devices and board is so."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from robominer_slam.configuration.file import ConfigurationError, load
from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.doctor.board_checks import check_board
from robominer_slam.doctor.credentials_checks import check_credentials
from robominer_slam.doctor.device_checks import check_devices
from robominer_slam.doctor.finding import Finding
from robominer_slam.security.endpoints import is_tls


def check_configuration(path: Path) -> Iterator[Finding]:
    """Check a file, the credentials that it names, and, where it names devices, them and this machine."""
    try:
        configuration = load(path)
    except ConfigurationError as error:
        for line in str(error).splitlines():
            yield Finding("configuration", "error", line, f"edit {path}")
        return
    yield Finding("configuration", "ok", f"{path} can be used")
    yield from _network(configuration.zenoh, path.parent)
    if configuration.device or configuration.robot.role == "slam":
        yield from check_devices(configuration, path.parent)
        yield from check_board(path.parent / configuration.store.path)


def _network(zenoh: ZenohSection, folder: Path) -> Iterator[Finding]:
    if zenoh.credentials is None:
        yield Finding("network", "ok", "loopback only: nothing leaves the machine")
        return
    if not any(is_tls(endpoint) for endpoint in (*zenoh.listen, *zenoh.connect)):
        text = "credentials are configured, but no endpoint is tls/: nobody can connect from outside"
        yield Finding("network", "warning", text, 'add "tls/0.0.0.0:7448" to [zenoh] listen')
    yield from check_credentials(folder / zenoh.credentials, robot=True)
