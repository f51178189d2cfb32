"""The configuration file read anew while the daemon runs: what takes effect at once, and what needs a restart."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from robominer_slam.configuration.file import ConfigurationError, load
from robominer_slam.configuration.log_section import LogSection
from robominer_slam.configuration.model import Configuration

log = logging.getLogger(__name__)

#: What can change live: nothing that has been built into a filter, a map or a connection.
LIVE = {
    "log": ("level", "repeats", "repeats_period"),
    "map": ("grid_cell", "obstacle_height"),
    "store": ("sync_s",),
}


class Reload:
    """Reads the file again whenever it is asked to.

    Attributes:
        path: the file.
    """

    def __init__(
        self, path: Path, configuration: Configuration, configure_log: Callable[[LogSection], None] = lambda _: None
    ) -> None:
        self.path = path
        self._configuration = configuration
        self._configure_log = configure_log
        self._asked = threading.Event()

    def ask(self) -> None:
        """Ask for it; what a signal handler may do."""
        self._asked.set()

    @property
    def wanted(self) -> bool:
        """Whether it was asked for and not done yet."""
        return self._asked.is_set()

    def read(self) -> Configuration | None:
        """The configuration with what can change live; None where nothing of it has changed or the file is broken."""
        self._asked.clear()
        try:
            found = load(self.path)
        except ConfigurationError as error:
            for line in str(error).splitlines():
                log.error("not reloaded, the old configuration stays: %s", line)
            return None
        old, new = flat(self._configuration), flat(found)
        changed = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
        live = [key for key in changed if is_live(key)]
        for key in live:
            log.info("reloaded: %s = %s, was %s", key, new.get(key), old.get(key))
        for key in changed:
            if not is_live(key):
                log.warning("%s has changed to %s: needs a restart", key, new.get(key))
        if not changed:
            log.info("reloaded: nothing has changed in %s", self.path)
        if not live:
            return None
        self._configuration = with_live(self._configuration, found)
        self._configure_log(self._configuration.log)
        return self._configuration


def is_live(key: str) -> bool:
    """Whether a key, as `flat` writes it, takes effect without a restart."""
    section, _, name = key.partition(".")
    return name in LIVE.get(section, ())


def with_live(old: Configuration, new: Configuration) -> Configuration:
    """`old` with the live keys of `new`."""
    sections = {
        section: getattr(old, section).model_copy(update={key: getattr(getattr(new, section), key) for key in keys})
        for section, keys in LIVE.items()
    }
    return old.model_copy(update=sections)


def flat(section: BaseModel, prefix: str = "") -> dict[str, Any]:
    """Every key with its section's names before it; devices by their names."""
    found: dict[str, Any] = {}
    for name, value in section:
        key = f"{prefix}{name}"
        if isinstance(value, BaseModel):
            found |= flat(value, f"{key}.")
        elif isinstance(value, tuple) and any(isinstance(one, BaseModel) for one in value):
            for one in value:
                found |= flat(one, f"{key}.{getattr(one, 'name', '')}.")
        else:
            found[key] = value
    return found
