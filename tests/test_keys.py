"""The authority's folder by the program: what is made, with which modes, and what is refused."""

from __future__ import annotations

import json
import stat
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from robominer_slam.cli.keys import keys
from robominer_slam.security.access_list import FILE_NAME, load_access_list
from robominer_slam.security.authority import Authority
from robominer_slam.security.credentials import load_credentials
from robominer_slam.security.errors import KeysError
from robominer_slam.security.inspection import inspect


def run(folder: Path, *arguments: str) -> Result:
    return CliRunner().invoke(keys, [*arguments, "--folder", str(folder)])


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority.create(tmp_path / "keys")


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_bundle_has_what_its_holder_needs_and_keys_are_private(tmp_path: Path):
    folder = tmp_path / "keys"
    assert run(folder, "init").exit_code == 0
    done = run(folder, "issue", "rm3", "--role", "robot", "--host", "robot.local", "--host", "192.168.7.2")
    assert done.exit_code == 0, done.output
    assert run(folder, "issue", "alice", "--role", "operator", "--days", "3").exit_code == 0
    robot, operator = folder / "holders" / "rm3", folder / "holders" / "alice"
    assert {path.name for path in robot.iterdir()} == {"ca.pem", "rm3.pem", "rm3.key", "access.json"}
    assert {path.name for path in operator.iterdir()} == {"ca.pem", "alice.pem", "alice.key"}
    for key in (robot / "rm3.key", operator / "alice.key", folder / "authority" / "ca.key"):
        assert mode(key) == 0o600
    assert mode(folder) == mode(operator) == 0o700
    facts = inspect(load_credentials(robot))
    assert (facts.name, facts.role) == ("rm3", "robot")
    assert {"robot.local", "192.168.7.2", "localhost", "127.0.0.1"} <= set(facts.hosts)
    facts = inspect(load_credentials(operator))
    assert (facts.name, facts.role, facts.hosts) == ("alice", "operator", ())
    assert abs(facts.ends - datetime.now(UTC) - timedelta(days=3)) < timedelta(minutes=5)
    # The robot's list has also who came after the robot.
    assert load_access_list(robot / FILE_NAME).names(["operator"]) == ("alice",)


def test_list_tells_each_state(authority: Authority):
    for name, days in (("valid", 30), ("soon", 3), ("expired", 0), ("gone", 30)):
        authority.issue(name, "viewer", days)
    authority.revoke("gone")
    done = run(authority.folder, "list", "--json")
    states = {entry["name"]: entry["state"] for entry in json.loads(done.output)}
    assert states == {"valid": "valid", "soon": "expires soon", "expired": "expired", "gone": "revoked"}
    table = run(authority.folder, "list").output
    assert all(word in table for word in ("gone", "revoked", "viewer", "expires soon"))


@pytest.mark.parametrize("name", ["", "ca", "../x", "a/b", "A", "a b", "*", "-a", "a-", "x" * 64, ".a", "a\n"])
def test_a_name_that_could_be_more_than_a_name_is_refused(authority: Authority, name: str):
    with pytest.raises(KeysError, match="expected 1 to 63"):
        authority.issue(name, "viewer")


@pytest.mark.parametrize("host", ["tcp/x", "a:1", "*.local", "a b", ""])
def test_a_host_that_is_none_is_refused(authority: Authority, host: str):
    with pytest.raises(KeysError, match="expected a host name or an address"):
        authority.issue("rm3", "robot", hosts=[host])
    assert not authority.access_list.holders


def test_nothing_is_overwritten_without_being_asked(authority: Authority):
    authority.issue("alice", "operator")
    key = authority.bundle("alice") / "alice.key"
    before = key.read_bytes(), (authority.folder / "authority" / "ca.key").read_bytes()
    with pytest.raises(KeysError, match="--replace"):
        authority.issue("alice", "operator")
    with pytest.raises(KeysError, match="--renew"):
        Authority.create(authority.folder)
    with pytest.raises(KeysError, match="keeps its role"):
        authority.issue("alice", "viewer", replace=True)
    assert before == (key.read_bytes(), (authority.folder / "authority" / "ca.key").read_bytes())
    authority.issue("alice", "operator", replace=True)
    assert key.read_bytes() != before[0]


def test_a_robot_keeps_its_hosts_when_its_certificate_is_replaced(authority: Authority):
    authority.issue("rm3", "robot", hosts=["robot.local"])
    assert "robot.local" in authority.issue("rm3", "robot", replace=True).hosts


def test_only_robots_have_hosts(authority: Authority):
    with pytest.raises(KeysError, match="leave --host out"):
        authority.issue("alice", "operator", hosts=["laptop"])


def test_a_revoked_name_is_off_every_list_and_never_given_again(authority: Authority):
    authority.issue("rm3", "robot")
    authority.issue("mallory", "operator")
    done = run(authority.folder, "revoke", "mallory")
    assert done.exit_code == 0
    assert "copy" in done.output
    assert "rm3" in done.output
    for path in (authority.folder, authority.bundle("rm3")):
        assert load_access_list(path / FILE_NAME).names(["operator"]) == ()
    with pytest.raises(KeysError, match="take another name"):
        authority.issue("mallory", "operator", replace=True)
    with pytest.raises(KeysError, match="was revoked already"):
        authority.revoke("mallory")
    with pytest.raises(KeysError, match="nobody has this name"):
        authority.revoke("nobody")


def test_a_renewed_authority_gives_new_certificates_to_all_but_the_revoked(authority: Authority):
    authority.issue("rm3", "robot", hosts=["robot.local"])
    authority.issue("alice", "operator")
    authority.issue("mallory", "operator")
    authority.revoke("mallory")
    old = load_credentials(authority.bundle("alice"))
    old_files = {path.name: path.read_bytes() for path in (old.authority, old.certificate, old.key)}
    done = run(authority.folder, "init", "--renew")
    assert done.exit_code == 0, done.output
    assert set(authority.access_list.holders) == {"rm3", "alice"}
    assert "robot.local" in inspect(load_credentials(authority.bundle("rm3"))).hosts
    new = load_credentials(authority.bundle("alice"))
    inspect(new)
    assert new.authority.read_bytes() != old_files["ca.pem"]
    new.certificate.write_bytes(old_files["alice.pem"])
    new.key.write_bytes(old_files["alice.key"])
    with pytest.raises(KeysError, match="not issued by"):
        inspect(new)
    assert list((authority.folder / "retired").glob("*/authority/ca.key"))


def test_a_key_of_another_certificate_is_found(authority: Authority):
    authority.issue("alice", "operator")
    authority.issue("bob", "viewer")
    alice, bob = load_credentials(authority.bundle("alice")), load_credentials(authority.bundle("bob"))
    with pytest.raises(KeysError, match="another certificate"):
        inspect(replace(alice, key=bob.key))
    alice.certificate.write_text("nonsense")
    with pytest.raises(KeysError, match="not a certificate"):
        inspect(alice)


def test_a_certificate_is_read_also_when_it_has_expired(authority: Authority):
    authority.issue("late", "viewer", 0)
    assert inspect(load_credentials(authority.bundle("late"))).ends <= datetime.now(UTC)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda bundle: (bundle / "bob.key").unlink(), "expected one NAME.key"),
        (lambda bundle: (bundle / "bob.pem").unlink(), "bob.pem: cannot be read"),
        (lambda bundle: (bundle / "two.key").write_text(""), "found bob.key, two.key"),
        (lambda bundle: (bundle / "ca.key").write_text(""), "authority's own folder"),
    ],
)
def test_a_bundle_that_lacks_something_is_one_clear_line(authority: Authority, spoil, expected: str):
    authority.issue("bob", "viewer")
    spoil(authority.bundle("bob"))
    with pytest.raises(KeysError, match=expected) as error:
        load_credentials(authority.bundle("bob"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "not an access list"),
        ('{"version": 2, "holders": []}', "of version 2"),
        ('{"version": 1, "holders": [{"name": "*"}]}', "not an access list"),
        ('{"version": 1}', "not an access list"),
    ],
)
def test_an_access_list_that_is_none_is_refused(tmp_path: Path, text: str, expected: str):
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(KeysError, match=expected):
        load_access_list(tmp_path / FILE_NAME)


@pytest.mark.parametrize(
    "change", [{"role": "emperor"}, {"name": "*"}, {"revoked": None}, {"expires": "2026-01-01T00:00:00"}]
)
def test_a_holder_that_is_none_spoils_the_list(authority: Authority, change: dict[str, object]):
    authority.issue("bob", "viewer")
    path = authority.folder / FILE_NAME
    content = json.loads(path.read_text())
    content["holders"][0].update(change)
    path.write_text(json.dumps(content))
    with pytest.raises(KeysError):
        load_access_list(path)


def test_every_command_has_an_example():
    for command in ("init", "issue", "list", "revoke"):
        assert "Example" in CliRunner().invoke(keys, [command, "--help"]).output
