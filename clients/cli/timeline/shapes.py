"""Shapes of a picture in pixels from its upper left corner, each with the name of its paint."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Rect:
    x: float
    y: float
    width: float
    height: float
    paint: str
    title: str = ""


@dataclass(frozen=True, slots=True)
class Area:
    """A filled polygon."""

    points: tuple[tuple[float, float], ...]
    paint: str
    title: str = ""


@dataclass(frozen=True, slots=True)
class Path:
    """An open line."""

    points: tuple[tuple[float, float], ...]
    paint: str
    title: str = ""
    dashed: bool = False
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class Label:
    x: float
    y: float
    text: str
    anchor: str = "start"  # start, middle, end
    size: float = 11.0
    paint: str = "text"


type Shape = Rect | Area | Path | Label


@dataclass(slots=True)
class Picture:
    """Shapes in the order in which they are drawn."""

    title: str
    description: str
    width: float
    height: float = 0.0
    shapes: list[Shape] = field(default_factory=list)
