"""Fuzzes every decoder: noise, mutations and damaged lines; prints what came through and how fast.

    python -m benchmarks.fuzz_decoders [BYTES]      10 million bytes for each decoder by default

A frame is wrong where its values equal none that was sent. Noise alone cannot give right frames, so all that come out
of it are wrong ones: protocols without a check, or with one of a byte, cannot know better.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from tests.device_streams import LINES, content, damaged, mutate

KINDS = ("clean", "damaged 1/1000", "mutated", "noise")
CHUNK = 1499


def main(total: int) -> None:
    print(f"{'decoder':36}{'stream':16}{'bytes':>11}{'sent':>9}{'accepted':>9}{'wrong':>7}{'buffer':>8}{'MB/s':>8}")
    for name, line in LINES.items():
        rng = np.random.default_rng(1)
        packets = line.packets(400, 1)
        good = b"".join(packets)
        sent = {content(reading)[2:] for reading in line.decoder().feed(good)}
        for kind in KINDS:
            decoder, accepted, wrong, peak, fed, seconds, count = line.decoder(), 0, 0, 0, 0, 0.0, 0
            while fed < total // len(KINDS):
                match kind:
                    case "clean":
                        piece = good
                    case "noise":
                        piece = rng.bytes(100_000)
                    case "mutated":
                        piece = mutate(good, rng)
                    case _:
                        piece = damaged(good, 0.001, rng)
                count += len(packets) if kind != "noise" else 0
                fed += len(piece)
                for at in range(0, len(piece), CHUNK):
                    begin = time.perf_counter()
                    readings = decoder.feed(piece[at : at + CHUNK])
                    seconds += time.perf_counter() - begin
                    accepted += len(readings)
                    wrong += sum(content(reading)[2:] not in sent for reading in readings)
                    peak = max(peak, len(decoder._buffer))
            rate = fed / seconds / 1e6
            print(f"{name:36}{kind:16}{fed:11}{count:9}{accepted:9}{wrong:7}{peak:8}{rate:8.1f}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000_000)
