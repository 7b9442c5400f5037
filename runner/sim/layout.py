"""Seeded episodes: which objects stand where, where the base starts, how the light falls.

Pure: the same seed gives the same layout on every machine. Must not know MuJoCo.
"""

from __future__ import annotations

import dataclasses
import math
import random

from vram_arbiter.runner.sim.config import COLOURS, SHAPES, ObjectSpec, SceneConfig


@dataclasses.dataclass(frozen=True, slots=True)
class Look:
    """The part of a layout that only cameras notice (RGB in 0..1)."""

    table_rgb: tuple[float, float, float]
    floor_rgb: tuple[float, float, float]
    ambient: float
    diffuse: float
    light_xy: tuple[float, float]


@dataclasses.dataclass(frozen=True, slots=True)
class Layout:
    """One episode before it starts. `objects[0]` is the target."""

    seed: int
    objects: tuple[ObjectSpec, ...]
    base_start: tuple[float, float, float]
    look: Look

    @property
    def target(self) -> str:
        """Name of the object the episode is about."""
        return self.objects[0].name


TABLES = ((0.62, 0.52, 0.40), (0.72, 0.70, 0.66), (0.50, 0.50, 0.52), (0.80, 0.76, 0.68))
FLOORS = ((0.30, 0.33, 0.36), (0.40, 0.38, 0.35), (0.24, 0.27, 0.30))
PLACING_TRIES = 400


def make_layout(seed: int, config: SceneConfig, *, names: tuple[str, ...] | None = None) -> Layout:
    """Return the layout of a seed: a target, one distractor of its color, one of its shape, the
    rest.

    The rest is random. `names` fixes the objects (first one is the target) and leaves only places
    and light to the seed. Raises ValueError for a name outside the vocabulary or when the objects
    do not fit on the zone.
    """
    rng = random.Random(f"tabletop-{seed}")
    pairs = _pairs(rng, config.object_count) if names is None else [_parse(name) for name in names]
    if len(set(pairs)) != len(pairs):
        raise ValueError("object names must differ: a name is how the robot tells them apart")
    spots = _spots(rng, len(pairs), config)
    objects = tuple(
        _make_object(rng, colour, shape, spot)
        for (colour, shape), spot in zip(pairs, spots, strict=True)
    )
    start = (
        rng.uniform(*config.start_x_m),
        rng.uniform(-config.start_y_m, config.start_y_m),
        rng.uniform(-config.start_yaw_rad, config.start_yaw_rad),
    )
    shade = rng.uniform(0.9, 1.08)
    table = rng.choice(TABLES)
    look = Look(
        table_rgb=(
            min(1.0, table[0] * shade),
            min(1.0, table[1] * shade),
            min(1.0, table[2] * shade),
        ),
        floor_rgb=rng.choice(FLOORS),
        ambient=rng.uniform(0.32, 0.46),
        diffuse=rng.uniform(0.42, 0.62),
        light_xy=(rng.uniform(-0.6, 1.2), rng.uniform(-0.9, 0.9)),
    )
    return Layout(seed=seed, objects=objects, base_start=start, look=look)


def _parse(name: str) -> tuple[str, str]:
    colour, _, shape = name.partition(" ")
    if colour not in COLOURS or shape not in SHAPES:
        raise ValueError(
            f"unknown object {name!r}: use a color of {list(COLOURS)} and a shape of {list(SHAPES)}"
        )
    return colour, shape


def _pairs(rng: random.Random, count: int) -> list[tuple[str, str]]:
    """Distinct (color, shape); the second shares the first's color, the third its shape."""
    every = [(colour, shape) for colour in COLOURS for shape in SHAPES]
    target = rng.choice(every)
    same_colour = rng.choice([p for p in every if p[0] == target[0] and p[1] != target[1]])
    same_shape = rng.choice([p for p in every if p[1] == target[1] and p[0] != target[0]])
    chosen = [target, same_colour, same_shape][:count]
    rest = [p for p in every if p not in chosen]
    rng.shuffle(rest)
    return chosen + rest[: count - len(chosen)]


def _spots(rng: random.Random, count: int, config: SceneConfig) -> list[tuple[float, float]]:
    """Return places on the zone, at least `object_spacing_m` apart (rejection with restarts)."""
    near, far = (config.table_edge_x_m + d for d in config.zone_from_edge_m)
    for _ in range(PLACING_TRIES):
        spots: list[tuple[float, float]] = []
        for _ in range(PLACING_TRIES):
            spot = (
                rng.uniform(near, far),
                rng.uniform(-config.zone_half_width_m, config.zone_half_width_m),
            )
            if all(math.dist(spot, other) >= config.object_spacing_m for other in spots):
                spots.append(spot)
            if len(spots) == count:
                return spots
    raise ValueError(f"{count} objects {config.object_spacing_m} m apart do not fit on the zone")


def _make_object(
    rng: random.Random, colour: str, shape: str, spot: tuple[float, float]
) -> ObjectSpec:
    size = {"cube": (0.027, 0.031), "ball": (0.032, 0.035), "cylinder": (0.027, 0.031)}[shape]
    width = rng.uniform(*size)
    height = rng.uniform(0.036, 0.042) if shape == "cylinder" else width
    return ObjectSpec(
        colour, shape, width, height, spot[0], spot[1], rng.uniform(-math.pi, math.pi)
    )
