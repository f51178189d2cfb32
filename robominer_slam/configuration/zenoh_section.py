"""Section `[zenoh]`: how the robot joins the network, and who in ROS 2 is to see it."""

from __future__ import annotations

from typing import Literal

from pydantic import ValidationInfo, field_validator

from robominer_slam.configuration.parameter import Section, parameter
from robominer_slam.security.endpoints import check


class ZenohSection(Section):
    """The network."""

    credentials: str | None = parameter(
        None, "", "folder with the robot's bundle from `keys issue`; without it nothing leaves the machine"
    )
    listen: tuple[str, ...] = parameter(
        ("tcp/127.0.0.1:7447",), "", "endpoints to listen on: loopback, and with credentials tls/0.0.0.0:7448"
    )
    connect: tuple[str, ...] = parameter((), "", "endpoints to connect to: loopback, and with credentials tls/")
    remote_ros: bool = parameter(
        False, "", "send ROS topics on TLS links at full rate: half a Mbit/s, too much for a slow one"
    )
    ros: Literal["none", "ros2dds", "rmw_zenoh"] = parameter(
        "none", "", "show the topics to ROS 2: ros2dds by zenoh-bridge-ros2dds, rmw_zenoh to nodes that run on it"
    )
    ros_domain: int = parameter(
        0, "1", "ROS_DOMAIN_ID of the nodes on rmw_zenoh; 0 is everybody's default", low=0, high=232
    )

    @field_validator("listen", "connect")
    @classmethod
    def _nothing_leaves_unprotected(cls, value: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        for endpoint in value:
            check(endpoint, credentials=bool(info.data.get("credentials")))
        return value
