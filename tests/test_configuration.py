"""The configuration: every mistake is one line with file, key and what was expected."""

from __future__ import annotations

import pytest
from pydantic import BaseModel

from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.file import ConfigurationError, load, parse, to_toml
from robominer_slam.configuration.model import Configuration


def test_an_empty_file_gives_the_defaults():
    assert parse("", "c.toml") == Configuration()


def test_the_printed_configuration_reads_back_the_same():
    text = '[[device]]\nname = "w"\nport = "/dev/x"\nmount_rpy_deg = [0, 1.5, 90]\n[slam]\nmethod = "none"\n'
    configuration = parse(text, "c.toml")
    printed = to_toml(configuration)
    assert parse(printed, "printed") == configuration
    assert "keyframe_distance = 0.12 # m; 0.01 to 5; thesis 3.4.4: along x or y" in printed


def test_every_protocol_prints_and_reads_back_with_its_own_keys_only():
    extra = {"rm3-motor": "screw = 'rear_left'", "rm3-compressed": "rows = 10\nsensor_period_us = 600"}
    protocols = ("framed", "rm3-plaintext", "rm3-compressed", "rm3-motor", "bno08x-rvc", "mip")
    text = "".join(
        f"[[device]]\nname = '{name}'\nport = '/dev/{name}'\nprotocol = '{name}'\n{extra.get(name, '')}\n"
        for name in protocols
    )
    configuration = parse(text, "c.toml")
    printed = to_toml(configuration)
    assert parse(printed, "printed") == configuration
    assert printed.count("representation =") == 2
    # The 3DM-CV7's z axis points down unless the configuration says how it is mounted.
    assert [device.mount_rpy_deg[0] for device in configuration.device] == [0, 0, 0, 0, 0, 180]
    settings = {one.protocol: one for one in device_settings(configuration)}
    assert (settings["rm3-compressed"].rows, settings["rm3-compressed"].representation) == (10, "spherical")
    assert settings["rm3-motor"].screw == "rear_left"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[slam]\nmetod = 'none'", "c.toml: slam.metod: unknown key; did you mean 'method'?"),
        ("[slam]\nmethod = 'best'", "c.toml: slam.method: expected 'robust', 'thesis' or 'none', found 'best'"),
        ("[slam]\nbackend_latency = '12 cm'", "c.toml: slam.backend_latency: expected a number in s, found '12 cm'"),
        ("[slam.thesis]\nkeyframe_distance = 12", "slam.thesis.keyframe_distance: expected less than or equal to 5 m"),
        ("[contact]\nmin_inclination_deg = nan", "contact.min_inclination_deg"),
        ("[[device]]\nname = 'a'", "c.toml: device[0].port: missing; expected path"),
        ("[[device]]\nname='a'\nport='/dev/x'\nbaudrate=3", "device[0].baudrate: unknown key; did you mean 'baud'?"),
        ("[[device]]\nname='a'\nport='/a'\n[[device]]\nname='a'\nport='/b'", "a stands twice"),
        ("[[device]]\nname='a'\nport='/x'\nprotocol='morse'", "device[0].protocol: expected 'framed', 'rm3-plaintext'"),
        (
            "[[device]]\nname='a'\nport='/x'\nprotocol='bno08x-rvc'\nrepresentation='cartesian'",
            "device[0]: expected no key representation with protocol 'bno08x-rvc': representation is for rm3-plaintext",
        ),
        ("[[device]]\nname='a'\nport='/x'\nscrew='rear_left'", "screw is for rm3-motor"),
        (
            "[[device]]\nname='a'\nport='/x'\nprotocol='rm3-motor'\nscrew='left'",
            "device[0].screw: expected 'front_right'",
        ),
        ("[robot]\nid = 'a/b'", "robot.id: expected a name without spaces"),
        ("[zenoh]\nlisten = 'tcp/x:1'", "zenoh.listen: expected a list"),
        ("[robot", "c.toml: not TOML"),
        ("[robots]", "c.toml: robots: unknown key; did you mean 'robot'?"),
    ],
)
def test_a_mistake_is_one_clear_line(text, expected):
    with pytest.raises(ConfigurationError) as error:
        parse(text, "c.toml")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_several_mistakes_are_a_line_each():
    with pytest.raises(ConfigurationError) as error:
        parse("[slam]\nmetod = 1\nbackend_latency = -1", "c.toml")
    assert len(str(error.value).splitlines()) == 2


def test_a_missing_file_is_said(tmp_path):
    with pytest.raises(ConfigurationError, match="No such file"):
        load(tmp_path / "none.toml")


def sections(model: type[BaseModel]):
    for name, field in model.model_fields.items():
        yield model, name, field
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from sections(inner)


def test_every_parameter_has_a_reason_a_unit_and_numbers_have_a_range():
    for model, name, field in sections(Configuration):
        inner = field.annotation
        if (isinstance(inner, type) and issubclass(inner, BaseModel)) or name == "device":
            continue
        assert field.description, f"{model.__name__}.{name} has no reason"
        assert isinstance(field.json_schema_extra, dict), f"{model.__name__}.{name} has no unit"
        if inner in (int, float):
            kinds = {type(m).__name__ for m in field.metadata}
            assert {"Ge", "Le"} <= kinds, f"{model.__name__}.{name} has no range"
            assert field.json_schema_extra["unit"], f"{model.__name__}.{name} has no unit"


@pytest.mark.parametrize(
    ("keys", "carries"),
    [
        ('name = "front"\nport = "auto"\nprotocol = "rm3-motor"', "screws"),
        ('name = "attitude"\nport = "auto"\nprotocol = "mip"', "imu"),
        ('name = "array"\nport = "auto"\nprotocol = "rm3-plaintext"', "whiskers"),
        ('name = "array"\nport = "auto"\ncalibration = "a.json"', "whiskers"),
        ('name = "imu"\nport = "auto"', "imu"),
        ('name = "something"\nport = "auto"', None),
    ],
)
def test_what_a_device_sends_is_told_by_calibration_protocol_or_name(keys, carries):
    (settings,) = device_settings(parse(f"[[device]]\n{keys}\n", "test.toml"))
    assert settings.carries == carries
