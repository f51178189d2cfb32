"""Matplotlib figures as elements of a page that needs nothing beside itself."""

from __future__ import annotations

import base64
import html
import io
from typing import Literal

from matplotlib.figure import Figure

#: Width of a picture, inches: narrow, so that its text can be read on a phone; wider ones can be scrolled there.
WIDTH_IN = 5.6
DPI = 150


def picture(figure: Figure, title: str, caption: str, kind: Literal["png", "svg"] = "png") -> str:
    """A `<figure>` with its image inside; `title` describes it for those who cannot see it, too."""
    wide = figure.get_figwidth() > WIDTH_IN
    buffer = io.BytesIO()
    # Without date and version the same runs give the same page.
    metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    figure.savefig(
        buffer, format=kind, dpi=DPI, facecolor="white", metadata=metadata, bbox_inches="tight", pad_inches=0.05
    )
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    mime = "image/svg+xml" if kind == "svg" else "image/png"
    name = html.escape(title)
    return (
        f'<figure{" class=wide" if wide else ""}><div><img src="data:{mime};base64,{data}" alt="{name}"></div>'
        f"<figcaption><b>{name}.</b> {html.escape(caption)}</figcaption></figure>"
    )
