"""A picture as PNG, by matplotlib, on a light ground."""

from pathlib import Path as File

from vram_arbiter.clients.cli.timeline.paints import LIGHT
from vram_arbiter.clients.cli.timeline.shapes import Area, Label, Path, Picture, Rect
from vram_arbiter.schemas.runtime.extras import need

SCALE = 1.5
"""Pixels of the file for one of the picture."""
DPI = 72.0 * SCALE
"""One pixel of the picture is one typographic point, as font sizes are."""
_ALIGN = {"start": "left", "middle": "center", "end": "right"}


def write(file: File, picture: Picture) -> None:
    """Draw a picture. Raises ConfigError without matplotlib, OSError where it cannot be written."""
    need("a timeline as PNG", "matplotlib", extra="runner")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon, Rectangle

    size = (picture.width / 72.0, picture.height / 72.0)
    figure = Figure(figsize=size, dpi=DPI, facecolor=LIGHT["ground"])
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, picture.width)
    axes.set_ylim(picture.height, 0.0)
    for order, shape in enumerate(picture.shapes):
        color = LIGHT[shape.paint]
        match shape:
            case Rect(x, y, width, height):
                axes.add_patch(Rectangle((x, y), width, height, color=color, lw=0, zorder=order))
            case Area(points) if points:
                axes.add_patch(Polygon(points, closed=True, color=color, lw=0, zorder=order))
            case Path(points):
                axes.plot(
                    [x for x, _ in points], [y for _, y in points], color=color, lw=shape.width,
                    ls=(0, (4, 4)) if shape.dashed else "-", zorder=order,
                )  # fmt: skip
            case Label(x, y, text, anchor, points_high):
                axes.text(
                    x, y, text, ha=_ALIGN[anchor], va="baseline", fontsize=points_high,
                    color=color, zorder=order, parse_math=False,
                )  # fmt: skip
    canvas.print_png(str(file))
