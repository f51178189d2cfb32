"""Single keys of a configuration set otherwise, for comparisons: `slam.thesis.kernel=none`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from robominer_slam.configuration.file import ConfigurationError, validate
from robominer_slam.configuration.model import Configuration, SlamSection

#: A dotted key and its value.
Override = tuple[str, Any]


@dataclass(frozen=True, slots=True)
class Variant:
    """A named set of overrides; the one without name and overrides is the configuration as it is."""

    label: str = ""
    overrides: tuple[Override, ...] = ()

    def concerns(self, method: str) -> bool:
        """Whether any override can matter to a SLAM method: those in another method's section cannot."""
        methods = set(get_args(SlamSection.model_fields["method"].annotation))
        for key, _ in self.overrides:
            section = key.split(".")[:2]
            foreign = section[0] == "slam" and (method == "none" or (section[-1] in methods - {method}))
            if not foreign:
                return True
        return not self.overrides


def parse_override(text: str) -> Override:
    """`key=value`; the value as TOML has it, or else text.

    Raises:
        ConfigurationError: no `=` in it, or an empty key.
    """
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not all(key.split(".")):
        raise ConfigurationError(f"{text!r}: expected KEY=VALUE, as slam.backend_latency=0.2")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value


def parse_variant(text: str) -> Variant:
    """`label:key=value,key=value`.

    Raises:
        ConfigurationError: no label, or an override that is none.
    """
    label, colon, rest = text.partition(":")
    if not label.strip() or not colon:
        raise ConfigurationError(f"{text!r}: expected LABEL:KEY=VALUE, several separated by commas")
    return Variant(label.strip(), tuple(parse_override(part) for part in rest.split(",")))


def overridden(configuration: Configuration, overrides: Mapping[str, Any], where: str) -> Configuration:
    """The configuration with some keys set otherwise, validated as a file would be; `where` names it in messages.

    Raises:
        ConfigurationError: an unknown key, a wrong type, a value outside its range.
    """
    data = configuration.model_dump(exclude_unset=True)
    for key, value in overrides.items():
        *sections, last = key.split(".")
        place = data
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigurationError(f"{where}: {key}: {section!r} is no section")
        place[last] = value
    return validate(data, where)
