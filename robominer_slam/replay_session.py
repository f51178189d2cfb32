"""The saved map that a replay starts in, and the database that its own map goes to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.replay import ReplayInputs
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store import MapStore
from robominer_slam.store_reader import map_to_start_in

SYNC_S = 0.5


@dataclass(frozen=True)
class ReplaySession:
    """What a replay starts from and writes to; None each where there is nothing of the kind."""

    known: SavedMap | None
    store: MapStore | None


def open_session(
    inputs: ReplayInputs, map_name: str | None, start: str | None, store_path: Path | None
) -> tuple[ReplayInputs, ReplaySession]:
    """Load the map and open the store.

    Args:
        inputs: of the replay.
        map_name: DATABASE or DATABASE:NAME; None to begin a new map.
        start: `continue` or `localize`; None for what the configuration says, or `localize`.
        store_path: where the map goes; None for nowhere.

    Returns:
        The inputs with a configuration that says the same, and the session.

    Raises:
        ConfigurationError: options that do not go together.
        StoreError: no such map, or a database that cannot be used.
    """
    slam = inputs.configuration.slam
    if map_name is None:
        if start is not None:
            raise ConfigurationError(f"--start {start}: needs --map DATABASE[:NAME]")
        inputs = _with_slam(inputs, {"start": "new"})
        store = None if store_path is None else _store(inputs, store_path, None)
        return inputs, ReplaySession(None, store)
    database, name = split_name(map_name)
    start = start or ("localize" if slam.start == "new" else slam.start)
    inputs = _with_slam(inputs, {"start": start, "map": name})
    if store_path is not None and (start == "localize" or store_path.resolve() != database.resolve()):
        raise ConfigurationError("--store: a map to go on with stays in its database, a frozen one as it is")
    map_id, known = map_to_start_in(inputs.configuration.slam, database)
    store = None if store_path is None else _store(inputs, store_path, map_id)
    return inputs, ReplaySession(known, store)


def split_name(text: str) -> tuple[Path, str]:
    """Path of the database, and name or id of the map in it (empty: the newest)."""
    path, colon, name = text.rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ""
    return Path(path), name


def _with_slam(inputs: ReplayInputs, update: dict[str, str]) -> ReplayInputs:
    slam = inputs.configuration.slam.model_copy(update=update)
    return replace(inputs, configuration=inputs.configuration.model_copy(update={"slam": slam}))


def _store(inputs: ReplayInputs, path: Path, map_id: int | None) -> MapStore:
    voxel = inputs.configuration.store.point_voxel
    return MapStore(path, SYNC_S, inputs.configuration.robot.id, "", map_id, point_voxel=voxel)
