"""Nothing leaves the machine without keys: which endpoints a configuration may name."""

from __future__ import annotations

import pytest

from robominer_slam.configuration.file import ConfigurationError, parse

LOOPBACK = ["tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "udp/127.0.0.2:1", "unixsock-stream//run/x"]
OUTSIDE = [
    "tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "tcp/[::]:7447", "udp/10.0.0.1:1", "ws/0.0.0.0:1", "tcp/robot:7447",
    "tcp/*:7447", "quic/0.0.0.0:7447", "quic/127.0.0.1:7447", "tcp/127.0.0.1.example.org:1", "tcp/:7447",
    "serial//dev/x", "TLS/0.0.0.0:7448", "tls", "",
]  # fmt: skip


def zenoh(key: str, endpoint: str, credentials: bool) -> str:
    keys = 'credentials = "rm3"\n' if credentials else ""
    return f'[zenoh]\n{key} = ["tcp/127.0.0.1:1", "{endpoint}"]\n{keys}'


@pytest.mark.parametrize("key", ["listen", "connect"])
@pytest.mark.parametrize("credentials", [False, True])
@pytest.mark.parametrize("endpoint", LOOPBACK)
def test_loopback_is_free(key: str, endpoint: str, credentials: bool):
    assert endpoint in getattr(parse(zenoh(key, endpoint, credentials), "x").zenoh, key)


@pytest.mark.parametrize("key", ["listen", "connect"])
@pytest.mark.parametrize("credentials", [False, True])
@pytest.mark.parametrize("endpoint", OUTSIDE)
def test_whatever_else_is_not_tls_is_refused_also_with_keys(key: str, endpoint: str, credentials: bool):
    with pytest.raises(ConfigurationError, match=rf"^x: zenoh\.{key}: expected") as error:
        parse(zenoh(key, endpoint, credentials), "x")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["listen", "connect"])
def test_tls_needs_keys_and_takes_no_options(key: str):
    parse(zenoh(key, "tls/0.0.0.0:7448", True), "x")
    with pytest.raises(ConfigurationError, match="credentials = 'FOLDER'"):
        parse(zenoh(key, "tls/0.0.0.0:7448", False), "x")
    with pytest.raises(ConfigurationError, match="nothing behind it"):
        parse(zenoh(key, "tls/0.0.0.0:7448#enable_mtls=false", True), "x")
