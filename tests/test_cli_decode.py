"""`robominer-slam decode` as the interface describes it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from click.testing import CliRunner

from drivers.decoders import PROTOCOLS
from robominer_slam.cli.main import cli
from tests.device_streams import LINES
from tests.test_decoders_imu import MIP_EXAMPLE, RVC_EXAMPLE


def run(arguments: list[str], data: bytes = b""):
    result = CliRunner().invoke(cli, ["decode", *arguments], input=data)
    return result, [json.loads(line) for line in result.stdout.splitlines()] if result.exit_code == 0 else []


@pytest.mark.parametrize("name", LINES)
def test_one_line_a_measurement_then_the_counters(tmp_path, name):
    protocol, _, variant = name.partition(" ")
    path = tmp_path / "port.bin"
    path.write_bytes(b"".join(LINES[name].packets(5, 1)))
    options = ["--protocol", protocol]
    if variant == "3x5":
        options += ["--rows", "3", "--cols", "5", "--representation", "cartesian"]
    elif protocol in ("rm3-plaintext", "rm3-compressed"):
        options += ["--representation", variant]
    result, lines = run([*options, str(path)])
    assert result.exit_code == 0
    assert len(lines) == 6
    assert all(list(line)[:3] == ["type", "t_us", "sequence"] for line in lines[:-1])
    assert lines[-1] == {"counters": {"packets": 5}}


def test_standard_input_and_the_data_sheets_examples():
    _, (rvc, counters) = run(["--protocol", "bno08x-rvc", "-"], RVC_EXAMPLE)
    assert (rvc["type"], rvc["t_us"], rvc["sequence"], rvc["gyro"]) == ("imu", None, 222, None)
    assert rvc["acceleration"][0] == pytest.approx(-3.638267, abs=1e-6)
    assert rvc["roll"] == pytest.approx(0.363901, abs=1e-6)
    assert counters == {"counters": {"packets": 1}}
    _, (mip, counters) = run(["--protocol", "mip", "-"], MIP_EXAMPLE)
    assert mip["acceleration"][2] is None
    assert counters == {"counters": {"not_finite": 1, "packets": 1}}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--protocol", "morse", "-"], "expected one of framed, rm3-plaintext"),
        (["--protocol", "mip", "/no/such/file"], "/no/such/file: cannot be read: No such file"),
        (["--protocol", "rm3-compressed", "--representation", "polar", "-"], "expected one of cartesian"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, said):
    program = [sys.executable, "-c", "from robominer_slam.cli.main import main; main()"]
    result = subprocess.run([*program, "decode", *arguments], capture_output=True, text=True, check=False, input="")
    assert result.returncode == 2
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""


def test_every_protocol_has_a_decoder_and_says_no_measurement_of_nothing():
    for protocol in PROTOCOLS:
        result, lines = run(["--protocol", protocol, "-"])
        assert result.exit_code == 0
        assert lines == [{"counters": {}}]
