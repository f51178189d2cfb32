"""Commands from the operator: `cmd/<name>`, answered with {"ok": bool, "message": str}; repeats are harmless."""

from __future__ import annotations

import json
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping

import numpy as np

from robominer_slam.configuration.relocalisation_section import RelocalisationSection
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.pipeline import Pipeline
from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError

log = logging.getLogger(__name__)

#: Answers kept by id, so that a repeated command is answered and not done again.
REMEMBERED = 256
STORE_TIMEOUT_S = 5.0
#: Of `localize`: deviation of the place where none is told, and what may be told, m.
DEFAULT_SIGMA_M = 0.3
SIGMA_RANGE_M = (0.02, 10.0)
#: Farther than this beyond three sigmas from any keyframe there is no mapped ground, m.
MAP_MARGIN_M = 1.0


class CommandError(ValueError):
    """A command that cannot be done; the message goes to the operator."""


class Commands:
    """Does what the operator asks; the caller holds the state's lock."""

    def __init__(
        self,
        pipeline: Pipeline,
        keyframe_map: KeyframeMap,
        store: MapStore,
        new_map: Callable[[], None],
        relocalisation: RelocalisationSection | None,
    ) -> None:
        """Take the parts that commands act on; `relocalisation` is None where the method cannot find its place."""
        self._pipeline = pipeline
        self._map = keyframe_map
        self._store = store
        self._new_map = new_map
        self._relocalisation = relocalisation
        self._answers: OrderedDict[tuple[str, str], bytes] = OrderedDict()
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
        # An id that comes again with another command is another command: its answer must not be taken for this one's.
        repeat = (name, identity)
        if identity and repeat in self._answers:
            log.info("command %s %s from %s: repeated, answered as before", name, identity, query.sender)
            return [Reply(self._answers[repeat])]
        try:
            handler = self.handlers.get(name)
            if handler is None:
                raise CommandError(f"unknown command {name!r}; expected one of {', '.join(sorted(self.handlers))}")
            answer = {"ok": True, "message": handler(query.parameters)}
        except CommandError as error:
            answer = {"ok": False, "message": str(error)}
        log.info("command %s %s from %s: %s", name, dict(query.parameters), query.sender, answer["message"])
        payload = json.dumps(answer).encode()
        if identity:
            self._answers[repeat] = payload
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
        if self._pipeline.runner is not None and self._relocalisation is None:
            raise CommandError("this SLAM method cannot be placed in its map; use new_map, or [slam] method = 'robust'")
        try:
            x, y, yaw = (float(parameters[name]) for name in ("x", "y", "yaw"))
            sigma = float(parameters.get("sigma", DEFAULT_SIGMA_M))
        except (KeyError, ValueError):
            raise CommandError("expected x= and y= in m, yaw= in rad, and sigma= in m or nothing") from None
        if not np.isfinite([x, y, yaw, sigma]).all():
            raise CommandError("expected finite numbers in x=, y=, yaw=, sigma=")
        if self._pipeline.runner is None or self._relocalisation is None:
            self._pipeline.localize(x, y, yaw)
            return f"placed at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad"
        low, high = SIGMA_RANGE_M
        if not low <= sigma <= high:
            raise CommandError(f"expected sigma= from {low} to {high} m")
        if not self._map.keyframes:
            raise CommandError("the map is still empty: there is nothing to be placed in")
        distance = float(np.hypot(*(self._map.poses[:, :2, 3] - [x, y]).T).min())
        if distance > 3.0 * sigma + MAP_MARGIN_M:
            raise CommandError(f"x {x:.2f} m, y {y:.2f} m is {distance:.1f} m from the nearest place of the map")
        sigma_yaw = float(np.deg2rad(self._relocalisation.sigma_yaw_deg))
        self._pipeline.localize_by_touch(PlacePrior(x, y, yaw, sigma, sigma_yaw))
        return (
            f"looking for the place near x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad; "
            "it counts once touches confirm it: drive"
        )

    def _save_map(self, parameters: Mapping[str, str]) -> str:
        if self._store.frozen:
            raise CommandError("the map is frozen ([slam] start = 'localize'): there is nothing to save")
        if not self._store.flush(STORE_TIMEOUT_S):
            raise CommandError("the disk did not take the map within 5 s; see status")
        name = parameters.get("name", "")
        try:
            self._store.save_poses(self._map.poses, self._map.ids, self._map.edges)
            if name:
                self._store.rename(name)
        except StoreError as error:
            raise CommandError(f"{error}; see status") from error
        return f"map {name or self._store.map_id} saved: {len(self._map.keyframes)} keyframes"

    def _start_new_map(self, _: Mapping[str, str]) -> str:
        self._new_map()
        return "a new map starts here"
