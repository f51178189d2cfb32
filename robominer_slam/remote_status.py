"""`status` for a slow link: whether it is due, and what of it fits."""

from __future__ import annotations

from collections.abc import Sequence

from robominer_slam.publishing import report_messages
from robominer_slam.publishing.report_messages import Diagnostic, Level
from robominer_slam.publishing.tls_settings import REMOTE_STATUS_BYTES

#: It comes at least this often.
INTERVAL_NS = 10_000_000_000
#: One who has just connected subscribes a moment later: it comes this many times at once.
GREETINGS = 3
#: The entry that always goes, and those of its figures that a remote operator needs.
FIRST = "localization"
FIGURES = ("localization.state", "paused", "keyframes", "map.version", "map.digest", "sigma_xy_m")
#: A message longer than this is cut, so that one entry does not take another's place.
MESSAGE_LENGTH = 60


class RemoteStatus:
    """Decides at each full `status` whether its short form is to be sent, too."""

    def __init__(self) -> None:
        self._sent_ns: int | None = None
        self._shown: object = None
        self._links: frozenset[str] = frozenset()
        self._greetings = 0

    def due(self, now_ns: int, entries: Sequence[Diagnostic], links: frozenset[str]) -> bool:
        """Whether to send: something has changed, ten seconds have passed, or somebody has come.

        Args:
            now_ns: monotonic time.
            entries: of the full status.
            links: who is connected remotely.
        """
        if links - self._links:
            self._greetings = GREETINGS
        self._links = links
        # Figures and texts change all the time; levels and the localisation's state do when something happens.
        states = [entry.values.get("localization.state") for entry in entries]
        paused = [entry.values.get("paused") for entry in entries]
        shown = ([(entry.name, entry.level) for entry in entries], states, paused)
        waited = self._sent_ns is None or now_ns - self._sent_ns >= INTERVAL_NS
        if not (waited or shown != self._shown or self._greetings):
            return False
        self._greetings = max(0, self._greetings - 1)
        self._sent_ns, self._shown = now_ns, shown
        return True


def short_status(stamp_ns: int, entries: Sequence[Diagnostic]) -> bytes:
    """diagnostic_msgs/DiagnosticArray of at most 400 bytes: the localisation, then what is not well, worst first."""
    first = [entry for entry in entries if entry.name == FIRST][:1]
    unwell = [entry for entry in entries if entry.level is not Level.OK and entry not in first]
    # STALE stands above ERROR by its number, but says less.
    unwell.sort(key=lambda entry: entry.level is Level.ERROR, reverse=True)
    chosen: list[Diagnostic] = []
    message = report_messages.diagnostics(stamp_ns, chosen)
    for entry in (*first, *unwell):
        values = {key: entry.values[key] for key in FIGURES if key in entry.values}
        cut = Diagnostic(entry.name[:MESSAGE_LENGTH], entry.level, _cut(entry.message), values)
        longer = report_messages.diagnostics(stamp_ns, [*chosen, cut])
        if len(longer) <= REMOTE_STATUS_BYTES:
            chosen.append(cut)
            message = longer
    return message


def _cut(text: str) -> str:
    # In bytes: what is not ASCII weighs more.
    raw = text.encode()
    return text if len(raw) <= MESSAGE_LENGTH else raw[: MESSAGE_LENGTH - 3].decode(errors="ignore") + "..."
