"""Commands from the operator: `cmd/<name>`, answered with {"ok": bool, "message": str}; repeats are harmless."""

from __future__ import annotations

import json
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping

import numpy as np

from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.pipeline import Pipeline
from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.store import MapStore

log = logging.getLogger(__name__)

#: Answers kept by id, so that a repeated command is answered and not done again.
REMEMBERED = 256
STORE_TIMEOUT_S = 5.0


class CommandError(ValueError):
    """A command that cannot be done; the message goes to the operator."""


class Commands:
    """Does what the operator asks; the caller holds the state's lock."""

    def __init__(
        self, pipeline: Pipeline, keyframe_map: KeyframeMap, store: MapStore, new_map: Callable[[], None]
    ) -> None:
        self._pipeline = pipeline
        self._map = keyframe_map
        self._store = store
        self._new_map = new_map
        self._answers: OrderedDict[str, bytes] = OrderedDict()
        self.handlers: dict[str, Callable[[Mapping[str, str]], str]] = {
            "pause": self._pause,
            "resume": self._resume,
            "rezero": self._rezero,
            "localize": self._localize,
            "save_map": self._save_map,
            "new_map": self._start_new_map,
        }

    def handle(self, query: Query) -> list[Reply]:
        """Answer one `cmd/<name>` query."""
        name = query.key.rsplit("/", 1)[-1]
        identity = query.parameters.get("id", "")
        if identity and identity in self._answers:
            return [Reply(self._answers[identity])]
        try:
            handler = self.handlers.get(name)
            if handler is None:
                raise CommandError(f"unknown command {name!r}; expected one of {', '.join(sorted(self.handlers))}")
            answer = {"ok": True, "message": handler(query.parameters)}
        except CommandError as error:
            answer = {"ok": False, "message": str(error)}
        log.info("command %s %s: %s", name, dict(query.parameters), answer["message"])
        payload = json.dumps(answer).encode()
        if identity:
            self._answers[identity] = payload
            while len(self._answers) > REMEMBERED:
                self._answers.popitem(last=False)
        return [Reply(payload)]

    def _pause(self, _: Mapping[str, str]) -> str:
        self._pipeline.paused = True
        return "mapping is paused; poses go on by dead reckoning"

    def _resume(self, _: Mapping[str, str]) -> str:
        self._pipeline.paused = False
        return "mapping goes on"

    def _rezero(self, _: Mapping[str, str]) -> str:
        if not self._pipeline.rezero():
            raise CommandError("no whisker frame has come yet; nothing to take as rest")
        return "the present reading is the rest position of every whisker"

    def _localize(self, parameters: Mapping[str, str]) -> str:
        if self._pipeline.runner is not None:
            raise CommandError("this SLAM method cannot be placed in its map; use new_map, or [slam] method = 'none'")
        try:
            x, y, yaw = (float(parameters[name]) for name in ("x", "y", "yaw"))
        except (KeyError, ValueError):
            raise CommandError("expected x= and y= in m and yaw= in rad") from None
        if not np.isfinite([x, y, yaw]).all():
            raise CommandError("expected finite numbers in x=, y=, yaw=")
        self._pipeline.localize(x, y, yaw)
        return f"placed at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad"

    def _save_map(self, parameters: Mapping[str, str]) -> str:
        if not self._store.flush(STORE_TIMEOUT_S):
            raise CommandError("the disk did not take the map within 5 s; see status")
        self._store.save_poses(self._map.poses, self._map.ids)
        name = parameters.get("name", "")
        if name:
            self._store.rename(name)
        return f"map {name or self._store.map_id} saved: {len(self._map.keyframes)} keyframes"

    def _start_new_map(self, _: Mapping[str, str]) -> str:
        self._new_map()
        return "a new map starts here"
