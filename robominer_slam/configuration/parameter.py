"""How a parameter is declared: default, unit, range and the reason for its value."""

from __future__ import annotations

import re
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

T = TypeVar("T")


def _one_key_chunk(value: str) -> str:
    if not value or any(c in "/*$?# " for c in value):
        raise ValueError("expected a name without spaces and without / * $ ? #")
    return value


#: A name that becomes one chunk of a Zenoh key.
KeyChunk = Annotated[str, AfterValidator(_one_key_chunk)]

#: A part of a ROS name: letters, digits and single underscores, no digit first
#: (https://design.ros2.org/articles/topic_and_service_names.html).
_ROS_NAME = re.compile(r"(?!.*__)[A-Za-z_][A-Za-z0-9_]*")


def is_ros_name(part: str) -> bool:
    """Whether a text may stand between the slashes of a ROS name."""
    return _ROS_NAME.fullmatch(part) is not None


class Section(BaseModel):
    """A section of the configuration file: unknown keys are refused, values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, validate_default=True)

    def concerns(self, _key: str) -> bool:
        """Whether a key means something here; one that does not is left out where the configuration is printed."""
        return True


def parameter(
    default: T,
    unit: str,
    reason: str,
    *,
    low: float | None = None,
    high: float | None = None,
) -> T:
    """Declare a parameter: for the type checker its value, as with pydantic's own `Field`.

    Args:
        default: the value when the file says nothing.
        unit: SI unit or `1` for numbers without; empty for text.
        reason: one sentence on why this value.
        low, high: the range, both ends allowed.
    """
    return Field(default=default, ge=low, le=high, description=reason, json_schema_extra={"unit": unit})
