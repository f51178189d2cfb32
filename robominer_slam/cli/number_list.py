"""Lists of whole numbers as users write them: `0-9`, `1,3,5-7`."""

from __future__ import annotations

import re


def number_list(text: str) -> list[int]:
    """Numbers and ranges, both ends included, in their order.

    Raises:
        ValueError: something else.
    """
    numbers: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*([0-9]+)\s*(?:-\s*([0-9]+)\s*)?", part)
        if found is None:
            raise ValueError(f"{text!r}: expected numbers and ranges, as 0-9 or 1,3")
        first = int(found[1])
        numbers += range(first, int(found[2] or first) + 1)
    return numbers
