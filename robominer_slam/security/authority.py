"""The authority's folder: its key, the access list, and a bundle for each holder to be copied to its machine.

authority/ca.key, ca.pem    the authority; the key never leaves this folder
access.json                 who has which role, and who was revoked
holders/<name>/             ca.pem, <name>.pem, <name>.key, and for robots access.json
retired/<time>/             what was before the authority was renewed
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from robominer_slam.security.access_list import FILE_NAME, AccessList, Holder, Role, checked_name, load_access_list
from robominer_slam.security.errors import KeysError
from robominer_slam.security.private_files import make_folder, write_file

DEFAULT_DAYS = 30
#: Under these a robot can always be called from itself.
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


class Authority:
    """Issues and revokes; everything is on disk."""

    def __init__(self, folder: Path) -> None:
        """Open an authority's folder.

        Raises:
            KeysError: there is no authority.
        """
        self.folder = folder
        if not self._certificate.exists() or not self._key.exists():
            raise KeysError(
                f"{folder}: there is no authority; make one with: robominer-slam keys init --folder {folder}"
            )

    @classmethod
    def create(cls, folder: Path) -> Authority:
        """Make an authority in a folder that has none.

        Raises:
            KeysError: there is one, or the folder cannot be written.
        """
        authority = cls.__new__(cls)
        authority.folder = folder
        if authority._certificate.exists() or authority._key.exists():
            raise KeysError(f"{folder}: there is an authority already; a new one in its place: keys init --renew")
        for path in (folder, folder / "authority", folder / "holders"):
            make_folder(path)
        authority._make()
        AccessList({}).save(folder / FILE_NAME)
        return authority

    @property
    def access_list(self) -> AccessList:
        """Who has which role."""
        return load_access_list(self.folder / FILE_NAME)

    def bundle(self, name: str) -> Path:
        """The folder to be copied to a holder's machine."""
        return self.folder / "holders" / name

    def issue(
        self, name: str, role: Role, days: int = DEFAULT_DAYS, hosts: Sequence[str] = (), *, replace: bool = False
    ) -> Holder:
        """Make a certificate and its bundle, and put the name on the access list.

        Args:
            name: of the holder.
            role: what it may do.
            days: how long it holds.
            hosts: host names and addresses of a robot, beside `localhost`; none: those it had.
            replace: give a new certificate to one who has one.

        Raises:
            KeysError: a name that was revoked, is taken or is none, hosts for one who is no robot.
        """
        from robominer_slam.security import certificates

        checked_name(name)
        access = self.access_list
        before = access.holders.get(name)
        if before is not None:
            self._check_replacement(before, role, replace)
        if hosts and role != "robot":
            raise KeysError(f"{name}: only a robot is called under a host name, {role}s call; leave --host out")
        if role == "robot":
            known = before.hosts if before is not None and not hosts else ()
            hosts = tuple(dict.fromkeys((*LOCAL_HOSTS, *known, *hosts)))
        made = certificates.issue(self._certificate.read_bytes(), self._read_key(), name, role, days, hosts)
        holder = Holder(name, role, made.serial, made.issued.isoformat(), made.expires.isoformat(), tuple(hosts))
        bundle = self.bundle(name)
        make_folder(bundle)
        write_file(bundle / f"{name}.key", made.key_pem, private=True)
        write_file(bundle / f"{name}.pem", made.certificate_pem, private=False)
        write_file(bundle / "ca.pem", self._certificate.read_bytes(), private=False)
        self._save(access.with_holder(holder))
        return holder

    def revoke(self, name: str) -> Holder:
        """Take a name off the list for good: it is never given again, as its certificate stays valid.

        Raises:
            KeysError: nobody has the name, or it was revoked before.
        """
        access = self.access_list
        holder = access.holders.get(name)
        if holder is None:
            known = ", ".join(sorted(access.holders)) or "nobody"
            raise KeysError(f"{name}: nobody has this name; on the list: {known}")
        if holder.revoked:
            raise KeysError(f"{name}: was revoked already, {holder.revoked}")
        access = access.without(name)
        self._save(access)
        return access.holders[name]

    def renew(self, days: int = DEFAULT_DAYS) -> list[Holder]:
        """A new authority in place of the old one, and new certificates for all who were not revoked.

        What was before moves to `retired/`. Every machine needs its new bundle: old and new do not know each other.
        """
        access = self.access_list
        retired = self.folder / "retired" / datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        make_folder(retired)
        for part in ("authority", "holders", FILE_NAME):
            (self.folder / part).rename(retired / part)
        renewed = Authority.create(self.folder)
        return [
            renewed.issue(holder.name, holder.role, days, holder.hosts)
            for holder in access.holders.values()
            if not holder.revoked
        ]

    @property
    def _certificate(self) -> Path:
        return self.folder / "authority" / "ca.pem"

    @property
    def _key(self) -> Path:
        return self.folder / "authority" / "ca.key"

    def _make(self) -> None:
        from robominer_slam.security import certificates

        made = certificates.make_authority()
        write_file(self._key, made.key_pem, private=True)
        write_file(self._certificate, made.certificate_pem, private=False)

    def _read_key(self) -> bytes:
        try:
            return self._key.read_bytes()
        except OSError as error:
            raise KeysError(f"{self._key}: cannot be read: {error.strerror}") from error

    def _check_replacement(self, before: Holder, role: Role, replace: bool) -> None:
        name = before.name
        if before.revoked:
            raise KeysError(f"{name}: was revoked; its old certificate would come back to life: take another name")
        if before.role != role:
            raise KeysError(f"{name}: is a {before.role}, and keeps its role as its old certificate does: another name")
        if not replace:
            raise KeysError(f"{name}: has a certificate until {before.expires}; a new one in its place: --replace")

    def _save(self, access: AccessList) -> None:
        """The list, and the copies in the robots' bundles."""
        access.save(self.folder / FILE_NAME)
        for holder in access.holders.values():
            if holder.role == "robot" and self.bundle(holder.name).is_dir():
                access.save(self.bundle(holder.name) / FILE_NAME)
