"""The height map as a picture (PNG) and as a GeoTIFF of float32 heights in metres (OGC 19-008r4)."""

from __future__ import annotations

import io

import numpy as np

from robominer_slam.mapping.height_grid import HeightGrid

#: GeoTIFF tags: pixel size, where a pixel lies, keys; and GDAL's for cells without a value.
PIXEL_SCALE, TIE_POINT, GEO_KEYS, NO_DATA_TAG = 33550, 33922, 34735, 42113
NO_DATA = -9999.0
#: Version 1.1.0 with two keys: the model is no known projection (a mine's own metres), a pixel is an area.
KEYS = (1, 1, 0, 2, 1024, 0, 1, 32767, 1025, 0, 1, 1)
_SHORT, _DOUBLE = 3, 12


def geotiff(grid: HeightGrid) -> bytes:
    """A GeoTIFF, north (y) up; untouched cells are -9999, its no-data value."""
    from PIL import Image, TiffImagePlugin

    heights = np.where(np.isfinite(grid.height), grid.height, NO_DATA).astype(np.float32)[::-1]
    x, y = grid.origin
    top = y + grid.cell * grid.height.shape[0]
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, values in (
        (PIXEL_SCALE, _DOUBLE, (grid.cell, grid.cell, 0.0)),
        (TIE_POINT, _DOUBLE, (0.0, 0.0, 0.0, x, top, 0.0)),
        (GEO_KEYS, _SHORT, KEYS),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = values
    tags[NO_DATA_TAG] = f"{NO_DATA:g}"
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(heights)).save(out, format="TIFF", tiffinfo=tags)
    return out.getvalue()


def picture(grid: HeightGrid, title: str) -> bytes:
    """A PNG for people: axes in metres, colours with a legend."""
    from matplotlib.figure import Figure

    ny, nx = grid.height.shape
    x, y = grid.origin
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    known = grid.height[np.isfinite(grid.height)]
    # Single wrong touches must not bleach the rest.
    low, high = np.percentile(known, [1.0, 99.0]) if len(known) else (0.0, 1.0)
    image = axes.imshow(
        grid.height,
        origin="lower",
        extent=(x, x + nx * grid.cell, y, y + ny * grid.cell),
        cmap="viridis",
        vmin=float(low),
        vmax=float(high),
        interpolation="nearest",
    )
    figure.colorbar(image, ax=axes, label="height (m)")
    axes.set(xlabel="x (m)", ylabel="y (m)", title=title)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=150)
    return out.getvalue()
