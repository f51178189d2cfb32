"""Files written whole or not at all, with the modes that keys need."""

from __future__ import annotations

import os
from pathlib import Path

from robominer_slam.security.errors import KeysError

PRIVATE_MODE = 0o600
PUBLIC_MODE = 0o644
FOLDER_MODE = 0o700


def make_folder(path: Path) -> None:
    """Make a folder that only its owner may enter.

    Raises:
        KeysError: it cannot be made.
    """
    try:
        path.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
    except OSError as error:
        raise KeysError(f"{path}: cannot be made: {error.strerror}") from error


def write_file(path: Path, content: bytes, *, private: bool) -> None:
    """Write beside and rename, so that a reader never sees half; a private file is never readable to others.

    Raises:
        KeysError: it cannot be written.
    """
    beside = path.with_name(f".{path.name}.new")
    mode = PRIVATE_MODE if private else PUBLIC_MODE
    try:
        beside.unlink(missing_ok=True)
        # Exclusive, with its mode from the start: nobody can have the file open from before.
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            # The umask may have taken bits away.
            os.fchmod(handle, mode)
            file.write(content)
            file.flush()
            os.fsync(handle)
        beside.replace(path)
    except OSError as error:
        raise KeysError(f"{path}: cannot be written: {error.strerror}") from error


def others_may_read(path: Path) -> bool:
    """Whether group or others may read or write the file."""
    return bool(path.stat().st_mode & 0o077)
