"""Counts as a table, against the budgets: `stage_table.py COUNTS.json SUMMARY.json`; exits 1 where one is missed.

Counts are the plugin's, the summary is what `counted_drive.py` has printed. Times are estimates for one core at 1 GHz
and 0.6 instructions per cycle.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from stages import EVERY_FRAME, STAGES

INSTRUCTIONS_PER_S = 0.6e9
FRAME_BUDGET = 4e6
SHARE_BUDGET = 0.5
NOT_THE_DRIVE = ("start", "not counted", "end")


def main() -> None:
    """Print the table."""
    counts, summary = (json.loads(Path(path).read_text(encoding="utf-8")) for path in sys.argv[1:3])
    by_stage = dict(zip(STAGES, (instructions for instructions, _ in counts["stages"][1:]), strict=False))
    frames, keyframes = summary["frames"], max(summary["keyframes"], 1)
    print("| stage | million | per frame | per keyframe | ms a frame |\n|---|---|---|---|---|")
    rows = {stage: by_stage[stage] for stage in STAGES if stage not in NOT_THE_DRIVE}
    every = sum(rows[stage] for stage in EVERY_FRAME)
    whole = sum(rows.values())
    rows |= {"**every frame**": every, "**all**": whole}
    for stage, count in rows.items():
        print(
            f"| {stage} | {count / 1e6:.0f} | {count / frames / 1e6:.3f} | {count / keyframes / 1e6:.1f} "
            f"| {1e3 * count / frames / INSTRUCTIONS_PER_S:.2f} |"
        )
    per_frame, share = every / frames, whole / INSTRUCTIONS_PER_S / summary["seconds"]
    print(f"\n{frames} frames, {keyframes} keyframes, {summary['closures']} loop closures")
    print(f"every frame: {per_frame / 1e6:.2f} million instructions of {FRAME_BUDGET / 1e6:.0f}")
    print(f"the whole drive: {100 * share:.0f} % of real time of {100 * SHARE_BUDGET:.0f}")
    sys.exit(per_frame > FRAME_BUDGET or share > SHARE_BUDGET)


if __name__ == "__main__":
    main()
