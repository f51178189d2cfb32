"""A holder's bundle: the folder with the authority's certificate, its own certificate and its key."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robominer_slam.security.access_list import FILE_NAME, AccessList, load_access_list
from robominer_slam.security.errors import KeysError


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files of a holder; whether they are any good, `inspection.py` tells.

    Attributes:
        name: the holder's, as its files are named.
        authority: the authority's certificate.
        certificate, key: the holder's own.
        access_file: the access list; robots have one.
    """

    name: str
    authority: Path
    certificate: Path
    key: Path
    access_file: Path

    def access_list(self) -> AccessList:
        """Who may do what on this robot.

        Raises:
            KeysError: no list, or one that cannot be read.
        """
        return load_access_list(self.access_file)


def load_credentials(folder: Path) -> Credentials:
    """Find the files of a bundle.

    Raises:
        KeysError: something is missing, or cannot be read by this user.
    """
    if not folder.is_dir():
        raise KeysError(f"{folder}: there is no such folder; expected a holder's bundle, made by: keys issue")
    try:
        keys = sorted(path for path in folder.iterdir() if path.suffix == ".key")
    except OSError as error:
        raise KeysError(f"{folder}: cannot be read: {error.strerror}") from error
    if any(key.name == "ca.key" for key in keys):
        raise KeysError(f"{folder}: the authority's own folder; its key must stay there: expected a holder's bundle")
    if len(keys) != 1:
        found = ", ".join(key.name for key in keys) or "none"
        raise KeysError(f"{folder}: expected one NAME.key of a holder's bundle, found {found}")
    name = keys[0].stem
    # Zenoh is given paths, and may stand in another folder.
    whole = folder.resolve()
    found_files = Credentials(name, whole / "ca.pem", whole / f"{name}.pem", whole / f"{name}.key", whole / FILE_NAME)
    for path in (found_files.authority, found_files.certificate, found_files.key):
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise KeysError(f"{path}: cannot be read: {error.strerror}") from error
    return found_files
