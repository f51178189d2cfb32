"""What a recording holds: topics and what they mean, and the metadata's names (interfaces.md, section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.ground_truth import TYPENAME as GROUND_TRUTH_TYPE
from drivers.ground_truth import WHISKERS_TYPENAME as WHISKER_TRUTH_TYPE
from drivers.measurement import SCREW_NAMES
from drivers.measurement_messages import (
    IMU,
    JOINT_STATE,
    MOTOR_FEEDBACK,
    ODOMETRY,
    TWIST_STAMPED,
    WHISKER_ARRAY,
)

PROFILE = "ros2"
SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"
METADATA_NAME = "robominer_slam"
SENSOR_PERIOD_KEY = "sensor_period_us"
#: Meanings of the topics on which a simulator tells the truth; nothing that is replayed.
GROUND_TRUTH = "ground_truth"
WHISKER_TRUTH = "whisker_truth"


class RecordingError(Exception):
    """A recording that cannot be read or written; the message is one line: file, what, what to do."""


@dataclass(frozen=True, slots=True)
class ForeignFormat:
    """A format of messages that are none of ROS's.

    Attributes:
        name: as the schema's.
        encoding: of the messages; readers that do not know it leave them alone.
        description: in words, and where to read more.
    """

    name: str
    encoding: str
    description: str


@dataclass(frozen=True, slots=True)
class TopicMeaning:
    """A role that a topic can play.

    Attributes:
        topic: the topic's name by default, without leading slash.
        types: message types that are understood in this role.
        screw: name of the screw it speaks for, where it speaks for one.
    """

    topic: str
    types: tuple[str, ...]
    screw: str | None = None


#: The keys are the names to use under `[topics]` in the configuration.
MEANINGS: dict[str, TopicMeaning] = {
    "whiskers": TopicMeaning("whiskers", (WHISKER_ARRAY,)),
    "imu": TopicMeaning("imu", (IMU,)),
    "screws": TopicMeaning("screws", (JOINT_STATE,)),
    **{
        f"{screw}_motor": TopicMeaning(f"{screw}/motor_module", (MOTOR_FEEDBACK, JOINT_STATE), screw)
        for screw in SCREW_NAMES
    },
    "odometry": TopicMeaning("odometry/twist", (TWIST_STAMPED, ODOMETRY)),
    GROUND_TRUTH: TopicMeaning(GROUND_TRUTH, (GROUND_TRUTH_TYPE,)),
    WHISKER_TRUTH: TopicMeaning("ground_truth/whiskers", (WHISKER_TRUTH_TYPE,)),
}


def resolve_topics(topics: Mapping[str, str] | None = None) -> dict[str, str]:
    """Topic (without leading slash) to meaning.

    Args:
        topics: meaning to topic where they differ from the default; a default topic's name is taken for its
            meaning too, a leading slash is ignored, and an empty topic turns the meaning off.

    Raises:
        RecordingError: an unknown meaning, or one topic for two meanings.
    """
    chosen = {meaning: entry.topic for meaning, entry in MEANINGS.items()}
    by_default_topic = {entry.topic: meaning for meaning, entry in MEANINGS.items()}
    for key, topic in (topics or {}).items():
        meaning = by_default_topic.get(key.strip("/"), key)
        if meaning not in MEANINGS:
            raise RecordingError(f"[topics] {key}: unknown; expected one of {', '.join(MEANINGS)}")
        chosen[meaning] = topic.strip("/")
    resolved: dict[str, str] = {}
    for meaning, topic in chosen.items():
        if not topic:
            continue
        if topic in resolved:
            raise RecordingError(
                f"[topics] {meaning} and {resolved[topic]} are both {topic!r}; a topic has one meaning"
            )
        resolved[topic] = meaning
    return resolved
