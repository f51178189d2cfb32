"""Reads the configuration file, and writes the effective one with units and reasons."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import tomlkit
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from tomlkit.items import Table

from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.parameter import Section


class ConfigurationError(ValueError):
    """A configuration that cannot be used; one line per mistake: file, key, what was expected."""


def load(path: Path) -> Configuration:
    """Read a TOML file.

    Raises:
        ConfigurationError: unreadable, not TOML, an unknown key, a wrong type, a value outside its range.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigurationError(f"{path}: cannot be read: {reason}") from error
    return parse(text, str(path))


def parse(text: str, where: str) -> Configuration:
    """Parse a configuration's text; `where` names it in messages. Raises as `load`."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{where}: not TOML: {error}") from error
    return validate(data, where)


def validate(data: Mapping[str, Any], where: str) -> Configuration:
    """A configuration from its keys; `where` names it in messages. Raises as `load`."""
    try:
        return Configuration.model_validate(data)
    except ValidationError as error:
        raise ConfigurationError("\n".join(_line(where, one) for one in error.errors())) from error


def _line(where: str, error: ErrorDetails) -> str:
    location = error["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    section, field = _find(location)
    kind = error["type"]
    if kind == "extra_forbidden":
        known = sorted(section.model_fields) if section is not None else []
        close = difflib.get_close_matches(str(location[-1]), known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known here: {', '.join(known)}"
        return f"{where}: {key}: unknown key; {hint}"
    if kind == "missing":
        return f"{where}: {key}: missing; expected {field.description if field else 'a value'}"
    unit = _unit(field) if field is not None else ""
    found = error.get("input")
    shown = f", found {found!r}" if isinstance(found, (str, int, float, bool)) else ""
    message = str(error["msg"]).removeprefix("Value error, ").removeprefix("Input should be ")
    if "number" in kind or (kind.startswith(("float", "int")) and kind.endswith(("parsing", "type"))):
        message = "a number"
    if kind == "tuple_type":
        message = "a list, as in [...]"
    message = message if message.startswith("expected") else f"expected {message}"
    suffix = "" if unit in ("", "1") else f" in {unit}" if message.endswith("a number") else f" {unit}"
    return f"{where}: {key}: {message}{suffix}{shown}"


def _find(location: tuple[int | str, ...]) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """The section that holds a key, and the key's declaration where it is known."""
    section: type[BaseModel] | None = Configuration
    field: FieldInfo | None = None
    for i, part in enumerate(location):
        if isinstance(part, int):
            continue
        if section is None:
            break
        found = section.model_fields.get(part)
        if found is None:
            return section, None
        field = found
        inner = _section_of(found.annotation)
        if inner is None or i == len(location) - 1:
            return section, field
        section = inner
    return section, field


def _section_of(annotation: object) -> type[BaseModel] | None:
    candidates = [annotation, *get_args(annotation)]
    return next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)


def _unit(field: FieldInfo) -> str:
    extra = field.json_schema_extra
    return str(extra.get("unit", "")) if isinstance(extra, dict) else ""


def to_toml(configuration: Configuration, *, comments: bool = True) -> str:
    """The effective configuration as TOML, each key with its unit, range and reason in a comment."""
    document = tomlkit.document()
    for name, value in configuration:
        if isinstance(value, BaseModel):
            document.add(name, _table(value, comments))
    devices = tomlkit.aot()
    for device in configuration.device:
        devices.append(_table(device, comments))
    if configuration.device:
        document.add("device", devices)
    text: str = tomlkit.dumps(document)
    return text


def _table(section: BaseModel, comments: bool) -> Table:
    table = tomlkit.table()
    for name, value in section:
        field = type(section).model_fields[name]
        if isinstance(section, Section) and not section.concerns(name):
            continue
        if isinstance(value, BaseModel):
            table.add(name, _table(value, comments))
        elif value is not None:
            item = tomlkit.item(list(value) if isinstance(value, tuple) else value)
            if comments:
                item.comment(_comment(field))
            table.add(name, item)
        elif comments:
            table.add(tomlkit.comment(f"{name} is not set: {_comment(field)}"))
    return table


def _comment(field: FieldInfo) -> str:
    parts = [_unit(field)] if _unit(field) not in ("", "1") else []
    bounds = {type(m).__name__: m for m in field.metadata}
    if "Ge" in bounds and "Le" in bounds:
        parts.append(f"{bounds['Ge'].ge:g} to {bounds['Le'].le:g}")
    choices = get_args(field.annotation)
    if choices and all(isinstance(c, str) for c in choices):
        parts.append(" | ".join(choices))
    return "; ".join([*parts, field.description or ""])
