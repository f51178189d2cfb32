"""`doctor` says why, where Zenoh only times out; through real TLS."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from robominer_slam.cli.doctor import doctor
from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.publishing.bus_messages import Reply
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.security.authority import Authority
from tests.secured_robot import PREFIX, SecuredRobot, free_ports


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredRobot]:
    robot = SecuredRobot(tmp_path_factory.mktemp("secured"))
    with robot.bus:
        for key in ("cmd/*", "map/snapshot"):
            robot.bus.queryable(key, lambda _: Reply(b"yes"))
        yield robot


def examine(*arguments: object) -> tuple[int, dict[str, tuple[str, str]]]:
    """Exit code, and by check the level and what is said, with what mends it."""
    done = CliRunner().invoke(doctor, [*map(str, arguments), "--json"])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    findings = json.loads(done.output)
    assert all(finding["mend"] for finding in findings if finding["level"] == "error")
    return done.exit_code, {f["check"]: (f["level"], f"{f['message']} | {f['mend']}") for f in findings}


@pytest.mark.parametrize(
    ("name", "says"), [("alice", "may look and command"), ("bob", "may look, not command, as a viewer")]
)
def test_it_is_content_with_who_may(robot: SecuredRobot, name: str, says: str):
    code, found = examine("--connect", robot.tls, "--credentials", robot.bundle(name))
    assert code == 0, found
    assert set(found) == {"credentials", "certificate", "network", "TLS", "Zenoh", "access"}
    assert says in found["access"][1]


def test_it_is_content_on_loopback(robot: SecuredRobot):
    code, found = examine("--connect", robot.tcp)
    assert (code, set(found)) == (0, {"network", "Zenoh", "access"})


def test_a_revoked_name(robot: SecuredRobot):
    code, found = examine("--connect", robot.tls, "--credentials", robot.bundle("mallory"))
    assert code == 1
    assert found["TLS"][0] == found["Zenoh"][0] == "ok"
    assert found["access"][0] == "error"
    assert "revoked" in found["access"][1]


def test_an_expired_certificate(robot: SecuredRobot):
    code, found = examine("--connect", robot.tls, "--credentials", robot.bundle("late"))
    assert code == 1
    assert "expired" in found["certificate"][1]
    assert "keys issue late --role operator --replace" in found["certificate"][1]
    assert "the robot refuses your certificate: expired" in found["TLS"][1]
    assert "Zenoh" not in found


def test_a_foreign_authority(robot: SecuredRobot):
    code, found = examine("--connect", robot.tls, "--credentials", robot.foreign.bundle("alice"))
    assert code == 1
    assert "another authority" in found["TLS"][1]


def test_a_foreign_certificate_with_the_robots_authority_beside_it(robot: SecuredRobot, tmp_path: Path):
    for name in ("alice.key", "alice.pem"):
        (tmp_path / name).write_bytes((robot.foreign.bundle("alice") / name).read_bytes())
    (tmp_path / "ca.pem").write_bytes((robot.bundle("bob") / "ca.pem").read_bytes())
    code, found = examine("--connect", robot.tls, "--credentials", tmp_path)
    assert code == 1
    assert "not issued by" in found["credentials"][1]
    # Also where nobody saw it before: the robot's own word.
    assert "does not know" in found["TLS"][1] or "refuses your certificate" in found["TLS"][1]


def test_no_certificate(robot: SecuredRobot):
    code, found = examine("--connect", robot.tls)
    assert code == 1
    assert "asks for a certificate, and got none | give --credentials" in found["TLS"][1]


def test_a_wrong_host_name(robot: SecuredRobot):
    elsewhere = robot.tls.replace("localhost", "127.0.0.2")
    # The robot listens on 127.0.0.1 alone: one that listens everywhere is needed.
    port = free_ports(1)[0]
    section = ZenohSection(credentials=str(robot.bundle("rm3")), listen=(f"tls/127.0.0.2:{port}",))
    with ZenohBus(robot_settings(section, Path(), PREFIX), PREFIX):
        address = f"{elsewhere.rpartition(':')[0]}:{port}"
        code, found = examine("--connect", address, "--credentials", robot.bundle("alice"))
    assert code == 1
    assert "not for the name 127.0.0.2" in found["TLS"][1]
    assert "--host 127.0.0.2 --replace" in found["TLS"][1]


@pytest.mark.parametrize(
    ("holder", "says"), [("late-robot", "the robot's certificate has expired"), ("alice", "no robot's certificate")]
)
def test_a_server_that_is_not_to_be_believed(robot: SecuredRobot, holder: str, says: str):
    if holder == "late-robot":
        robot.authority.issue(holder, "robot", 0, replace=True)
    port = free_ports(1)[0]
    (robot.bundle(holder) / "access.json").write_bytes((robot.bundle("rm3") / "access.json").read_bytes())
    section = ZenohSection(credentials=str(robot.bundle(holder)), listen=(f"tls/127.0.0.1:{port}",))
    with ZenohBus(robot_settings(section, Path(), PREFIX), PREFIX):
        code, found = examine("--connect", f"tls/localhost:{port}", "--credentials", robot.bundle("bob"))
    assert code == 1
    assert says in found["TLS"][1]


def test_a_closed_port_an_unknown_name_and_a_port_without_tls(robot: SecuredRobot):
    bundle = robot.bundle("alice")
    port = free_ports(1)[0]
    assert "port is closed" in examine("--connect", f"tls/127.0.0.1:{port}", "--credentials", bundle)[1]["network"][1]
    assert "no machine has the name" in examine("--connect", "tls/robot.invalid:1")[1]["network"][1]
    plain = robot.tcp.replace("tcp/127.0.0.1", "tls/localhost")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        place = f"tls/localhost:{silent.getsockname()[1]}"
        code, found = examine("--connect", place, "--credentials", bundle, "--timeout", "0.5")
    assert code == 1
    assert found["TLS"][0] == "error"
    code, found = examine("--connect", plain, "--credentials", bundle, "--timeout", "0.5")
    assert code == 1
    assert found["TLS"][0] == "error"


@pytest.mark.parametrize("endpoint", ["tls/robot", "quic/robot:1", "robot:1", "tls/robot:99999"])
def test_an_endpoint_that_is_none(endpoint: str):
    code, found = examine("--connect", endpoint)
    assert code == 1
    assert "expected tcp/HOST:PORT" in found["network"][1]


@pytest.fixture
def keys(tmp_path: Path) -> Authority:
    authority = Authority.create(tmp_path / "keys")
    authority.issue("alice", "operator")
    authority.issue("rm3", "robot")
    return authority


def configured(tmp_path: Path, name: str, listen: str = "tls/0.0.0.0:7448") -> Path:
    config = tmp_path / "config.toml"
    config.write_text(f'[zenoh]\nlisten = ["{listen}"]\ncredentials = "keys/holders/{name}"\n')
    return config


def test_a_configuration_that_is_well(tmp_path: Path, keys: Authority):
    code, found = examine("--config", configured(tmp_path, "rm3"))
    assert code == 0, found
    assert {level for level, _ in found.values()} == {"ok"}
    assert "operators: alice" in found["access list"][1]


def test_what_can_be_wrong_with_the_robots_own_keys(tmp_path: Path, keys: Authority):
    code, found = examine("--config", configured(tmp_path, "alice"))
    assert code == 1
    assert "cannot serve" in found["role"][1]
    assert "access.json" in found["access list"][1]
    key = keys.bundle("rm3") / "rm3.key"
    key.chmod(0o644)
    code, found = examine("--config", configured(tmp_path, "rm3"))
    assert code == 1
    assert f"chmod 600 {key}" in found["key"][1]
    key.chmod(0o600)
    keys.issue("rm3", "robot", 3, replace=True)
    code, found = examine("--config", configured(tmp_path, "rm3", "tcp/127.0.0.1:1"))
    assert code == 0
    assert found["certificate"][0] == found["network"][0] == "warning"
    keys.revoke("rm3")
    code, found = examine("--config", configured(tmp_path, "rm3"))
    assert code == 1
    assert "was revoked" in found["name"][1]
    key.unlink()
    assert "expected one NAME.key" in examine("--config", configured(tmp_path, "rm3"))[1]["credentials"][1]


def test_a_configuration_that_cannot_be_read(tmp_path: Path):
    config = tmp_path / "config.toml"
    config.write_text('[zenoh]\nlisten = ["tcp/0.0.0.0:1"]\n')
    code, found = examine("--config", config)
    assert code == 1
    assert "zenoh.listen" in found["configuration"][1]


def test_nothing_to_look_at_is_a_mistake():
    assert CliRunner().invoke(doctor, []).exit_code == 2
