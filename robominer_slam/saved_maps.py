"""Answers to queries of `map/saved`: which maps the robot's disk holds, and one of them as a map stream.

Read with a connection of its own and without the state's lock: a large map takes a second to load, and poses go on.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path

from robominer_slam import geometry
from robominer_slam.publishing.bus_messages import Query, QueryRefusedError, Reply
from robominer_slam.publishing.map_answers import MapAnswers, MapQueryError
from robominer_slam.publishing.map_stream_encoder import MapStreamEncoder
from robominer_slam.store_database import StoreError
from robominer_slam.store_reader import load_map, maps_in

#: Listed are the newest: the list stays below what a slow link carries in one message.
MOST_LISTED = 100
JSON = "application/json"


class SavedMaps:
    """The maps in one database. Safe to use from several threads.

    Args:
        path: of the database.
        present: number of the map that the robot is in; 0 where it has none yet.
        cell: see `MapStreamEncoder`.
    """

    def __init__(self, path: Path, present: Callable[[], int], cell: float | None) -> None:
        self._path = path
        self._present = present
        self._cell = cell
        self._lock = threading.Lock()
        self._opened: tuple[int, MapAnswers] | None = None

    def answer(self, query: Query) -> list[Reply]:
        """The list, or with `map=` the stream of that map; parameters as of `map/snapshot`, docs/map-stream.md.

        Raises:
            QueryRefusedError: there is no such map, or a parameter that means nothing.
        """
        wanted = query.parameters.get("map")
        try:
            if wanted is None:
                return [Reply(self._list(), JSON)]
            with self._lock:
                answers = self._answers(wanted, begin="answer" not in query.parameters)
                return [Reply(payload) for payload in answers.answer(query.parameters)]
        except (StoreError, MapQueryError) as error:
            raise QueryRefusedError(str(error)) from error

    def _list(self) -> bytes:
        known = maps_in(self._path) if self._path.exists() else []
        return json.dumps(
            {
                "maps": [
                    {
                        "id": one.number,
                        "name": one.name,
                        "created_unix_ns": one.created_unix_ns,
                        "keyframes": one.keyframes,
                        "present": one.number == self._present(),
                    }
                    for one in reversed(known[-MOST_LISTED:])
                ]
            }
        ).encode()

    def _answers(self, wanted: str, *, begin: bool) -> MapAnswers:
        """Answers for one map, which is read anew when a receiver begins with it."""
        if not begin and self._opened is not None and str(self._opened[0]) == wanted:
            return self._opened[1]
        number, saved = load_map(self._path, wanted)
        stream = MapStreamEncoder(number, self._cell)
        stream.update(1, saved.keyframes, geometry.to_vector7(saved.poses))
        self._opened = number, MapAnswers(stream)
        return self._opened[1]
