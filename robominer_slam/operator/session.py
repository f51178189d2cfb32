"""Where the console has its robot from: a live link or a recording; the page cares for neither."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from robominer_slam.operator.commands import CommandResult
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.operator.saved_maps import SavedMapEntry
from robominer_slam.publishing.map_state import MapState


class Session(Protocol):
    """What the page needs: something to show and someone to ask.

    Attributes:
        view: what is known of the robot.
        robot: its id.
    """

    view: RobotView
    robot: str

    def saved_maps(self) -> list[SavedMapEntry]:
        """Maps on the robot's disk, the newest first; waits for its answer.

        Raises:
            QueryError: no answer.
        """

    def saved_map(self, number: int) -> MapState:
        """One of them; waits until it is here.

        Raises:
            QueryError: it did not come.
        """

    def command(self, name: str, parameters: Mapping[str, str], /) -> CommandResult:
        """Ask the robot to do something; waits for its answer."""
