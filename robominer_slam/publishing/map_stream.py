"""The map stream: what a robot publishes of its map, and how a receiver keeps a copy. See docs/map-stream.md."""

from __future__ import annotations

from robominer_slam.publishing.map_records import MAX_MESSAGE_BYTES, MapStreamError
from robominer_slam.publishing.map_state import MapState, StreamKeyframe
from robominer_slam.publishing.map_stream_decoder import MapStreamDecoder
from robominer_slam.publishing.map_stream_encoder import MapStreamEncoder

__all__ = [
    "MAX_MESSAGE_BYTES",
    "MapState",
    "MapStreamDecoder",
    "MapStreamEncoder",
    "MapStreamError",
    "StreamKeyframe",
]
