"""Host time of samples from devices that cannot be asked for the time: the lower envelope of arrival times.

A sample may arrive late, never early. So the line under all points (count, arrival time), as high as it goes, is when
samples would have arrived without delays; stalls and bursts lie above it and change nothing. The line is the edge of
the lower convex hull over the mean count, which minimises the sum of the distances (Moon, Skelly, Towsley: Estimation
and removal of clock skew from network delay measurements, INFOCOM 1999). Points are thinned to the least late one of
each half second, and forgotten after half a minute.

The count is the device's own (a time stamp, a packet's index) or, where it sends none, that of the samples. Then
losses are inferred: after a stall the backlog comes at once; samples that stay late at their usual distance are ones
before which others were lost.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

#: A sample this late: no stall lasts so long, the device started anew.
JUMP_NS = 10_000_000_000
#: A sample this early: no error of the line is so large, the device's count has jumped.
EARLY_NS = 50_000_000
#: Samples that are all late by more than this for so long: the device's own schedule has shifted.
SHIFT_NS = 4_000_000
SHIFT_AFTER_NS = 1_500_000_000
#: Thinning of points: at first quickly, so that there is a line soon.
FIRST_BIN_NS = 50_000_000
FIRST_BINS_SPAN_NS = 2_000_000_000
BIN_NS = 500_000_000
BINS = 64
#: Samples are stamped once the line rests on that many, or on this long.
WARM_UP_SAMPLES = 8
WARM_UP_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class Counting:
    """What a device's counts are.

    Attributes:
        step_ns: nominal time of one count; None where it has to be found out.
        tolerance: of the nominal step, relative.
        settle_ns: the step is taken as nominal until the points span this long.
        modulus: at which the count wraps; None: never.
    """

    step_ns: float | None
    tolerance: float
    settle_ns: int
    modulus: int | None = None


#: A time stamp in microseconds from a crystal: good to 100 ppm, with margin.
DEVICE_TIME = Counting(1000.0, 500e-6, 5_000_000_000)
#: Samples of a device that sends no count: the period is found out.
SAMPLES = Counting(None, 1.0, 1_000_000_000)


class ArrivalClock:
    """Maps the counts of one device to monotonic host nanoseconds.

    Attributes:
        jumps: how often the device started anew or its schedule shifted.
        step_ns: estimated time of one count; 0 while unknown.
        inferred_losses: samples that were found missing where the device does not count.
    """

    def __init__(self, counting: Counting) -> None:
        self._counting = counting
        self.jumps = 0
        self.inferred_losses = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the device was opened anew."""
        self.step_ns = self._counting.step_ns or 0.0
        self._bins: deque[tuple[int, int]] = deque(maxlen=BINS)
        self._bin_from_ns = 0
        self._least: tuple[int, int] | None = None
        self._count: int | None = None
        self._arrival_ns = 0
        self._first_ns = 0
        self._samples = 0
        self._warm = False
        self._settled = False
        self._origin = 0  # count at which the line is at _line_ns
        self._line_ns = 0.0
        self._late_since_ns: int | None = None
        self._least_late_ns = 0.0
        self._unsettled = 0  # samples in a row that were taken as delayed

    @property
    def synchronised(self) -> bool:
        """Whether samples have good stamps."""
        return self.step_ns > 0.0 and self._warm

    @property
    def drift(self) -> float:
        """Rate error of the device's clock against nominal, dimensionless; 0 without a nominal rate."""
        nominal = self._counting.step_ns
        return 0.0 if nominal is None or not self.step_ns else nominal / self.step_ns - 1.0

    @property
    def offset_ns(self) -> int:
        """Host time of count zero, ns."""
        return round(self._line_ns - self._origin * self.step_ns)

    def add(self, arrival_ns: int, sent: int | None = None) -> int:
        """Take a sample.

        Args:
            arrival_ns: when it arrived.
            sent: the device's count as sent; None where it sends none.

        Returns:
            When it would have arrived without delay, ns; never after it has.
        """
        count = self._next_count(arrival_ns, sent)
        if count is None:
            self.jumps += 1
            self.reset()
            count = 0 if sent is None else sent
        if self._count is None:
            self._origin, self._line_ns = count, float(arrival_ns)
            self._first_ns = self._bin_from_ns = arrival_ns
        elif sent is None and self.step_ns:
            count = self._infer_losses(count, arrival_ns)
        late = arrival_ns - self._line(count) if self.step_ns else 0.0
        if late > JUMP_NS:
            self.jumps += 1
            self.reset()
            return self.add(arrival_ns, sent)
        if late < -EARLY_NS:
            self._shift(count, arrival_ns, late)
        elif late < 0.0:
            # Earlier than the line: the line was too high.
            self._line_ns += late
        elif self._shifted(late, arrival_ns):
            self._shift(count, arrival_ns, self._least_late_ns)
        late = max(0.0, arrival_ns - self._line(count)) if self.step_ns else 0.0
        self._count, self._arrival_ns = count, arrival_ns
        self._samples += 1
        self._warm |= self._samples >= WARM_UP_SAMPLES or (
            self._samples >= 2 and arrival_ns - self._first_ns >= WARM_UP_NS
        )
        self._keep(count, arrival_ns, late)
        return round(arrival_ns - late)

    def _line(self, count: int) -> float:
        return self._line_ns + (count - self._origin) * self.step_ns

    def _next_count(self, arrival_ns: int, sent: int | None) -> int | None:
        """The count of a sample, unwrapped; None where the device started anew."""
        if self._count is None:
            return 0 if sent is None else sent
        if sent is None:
            return self._count + 1
        modulus = self._counting.modulus
        if modulus is None:
            return sent if sent >= self._count else None
        ahead = (sent - self._count) % modulus
        if self.step_ns:
            # Whole turns of the count that were lost.
            elapsed = (arrival_ns - self._arrival_ns) / self.step_ns
            ahead += modulus * max(0, round((elapsed - ahead) / modulus))
            if arrival_ns - self._line(self._count + ahead) < -self.step_ns * modulus / 4:
                return None
        return self._count + ahead

    def _infer_losses(self, count: int, arrival_ns: int) -> int:
        late = arrival_ns - self._line(count)
        if late < -0.5 * self.step_ns:
            # It cannot be early: fewer were lost than was thought.
            return count + round(late / self.step_ns)
        if late < 0.5 * self.step_ns:
            self._unsettled = 0
            return count
        self._unsettled += 1
        if self._unsettled > 1 and arrival_ns - self._arrival_ns > 0.5 * self.step_ns:
            missing = round(late / self.step_ns)
            self.inferred_losses += missing
            self._unsettled = 0
            return count + missing
        return count

    def _shifted(self, late: float, arrival_ns: int) -> bool:
        """Whether all samples have been late for so long that it is no delay."""
        if not self.step_ns or late <= SHIFT_NS:
            self._late_since_ns = None
            return False
        if self._late_since_ns is None:
            self._late_since_ns, self._least_late_ns = arrival_ns, late
        self._least_late_ns = min(self._least_late_ns, late)
        return arrival_ns - self._late_since_ns > SHIFT_AFTER_NS

    def _shift(self, count: int, arrival_ns: int, by_ns: float) -> None:
        self.jumps += 1
        self._late_since_ns = None
        self._bins.clear()
        self._least = None
        self._bin_from_ns = self._first_ns = arrival_ns
        self._line_ns = self._line(count) + by_ns
        self._origin = count

    def _keep(self, count: int, arrival_ns: int, late: float) -> None:
        """Keep the least late sample of each bin; with a bin full, draw the line anew."""
        least = self._least
        # Without a period, the last of a burst is the least late.
        if least is None or not self.step_ns or late <= least[1] - self._line(least[0]):
            self._least = count, arrival_ns
        length = FIRST_BIN_NS if arrival_ns - self._first_ns < FIRST_BINS_SPAN_NS else BIN_NS
        if arrival_ns - self._bin_from_ns >= length and self._least is not None:
            self._bins.append(self._least)
            self._bin_from_ns, self._least = arrival_ns, None
            self._fit()

    def _fit(self) -> None:
        points = self._bins
        first_count, first_ns = points[0]
        x = [count - first_count for count, _ in points]
        y = [arrival - first_ns for _, arrival in points]
        nominal = self._counting.step_ns
        if y[-1] < self._counting.settle_ns:
            # Whatever was learned before the schedule shifted is better than a guess from a few points.
            if nominal is None and not self._settled:
                slopes = [(y[j] - y[i]) / (x[j] - x[i]) for j in range(len(x)) for i in range(j) if x[j] > x[i]]
                self.step_ns = max(median(slopes), 0.0) if len(slopes) > 1 else 0.0
        else:
            step = _slope_under(x, y)
            if nominal is not None:
                spread = nominal * self._counting.tolerance
                step = min(max(step, nominal - spread), nominal + spread)
            if step > 0.0:
                self.step_ns, self._settled = step, True
        height = min(ordinate - self.step_ns * abscissa for abscissa, ordinate in zip(x, y, strict=True))
        # The origin moves along, so that the line stays exact in floating point.
        self._origin = points[-1][0]
        self._line_ns = first_ns + height + self.step_ns * x[-1]


def _slope_under(x: list[int], y: list[int]) -> float:
    """Slope of the lower convex hull's edge over the mean of x (ascending)."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) >= 2:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[i] - y[a]) > (y[b] - y[a]) * (x[i] - x[a]):
                break
            hull.pop()
        if hull and x[hull[-1]] == x[i]:
            continue
        hull.append(i)
    middle = sum(x) / len(x)
    for a, b in pairwise(hull):
        if x[b] >= middle:
            return (y[b] - y[a]) / (x[b] - x[a])
    return 0.0
