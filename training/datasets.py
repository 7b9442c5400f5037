"""What is recorded and trained on: labeled frames, and tries as plain arrays.

The simulator is not known here: recording and training meet on these files only. A folder of
frames has `labels.jsonl`, one JSON object a frame, and the PNGs that it names. A folder of tries
has `info.json` and one .npy file a column: a step is small pictures and a few numbers, so that
random access by index is all that a trainer needs, and a video codec would blur objects that are
twelve pixels wide.
"""

from __future__ import annotations

import dataclasses
import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from training.common import BadInput
from vram_arbiter.schemas.plain import JsonMap, JsonObject

if TYPE_CHECKING:
    from numpy.typing import NDArray

LABELS: Final = "labels.jsonl"
INFO: Final = "info.json"
# Below this many visible pixels (at the frame's own size) an object is too hidden for a yes or no.
CLEAR_PIXELS: Final = 100
type Words = tuple[list[str], list[str]]
"""Colors and shapes, which names of objects are made of."""


# -- frames
@dataclasses.dataclass(frozen=True, slots=True)
class SeenObject:
    """One visible object of a frame. `box` is (x0, y0, x1, y1) in pixels, of its visible part."""

    name: str
    box: tuple[float, float, float, float]
    pixels: int

    @property
    def clear(self) -> bool:
        """Whether a model must see it; otherwise neither a yes nor a no is wrong."""
        return self.pixels >= CLEAR_PIXELS


@dataclasses.dataclass(frozen=True, slots=True)
class Frame:
    """One labeled image. `scene` groups frames of the same episode: a split never separates them.

    `objects` are those that show in the image, `present` names all that exist in the scene, as
    `COLOR SHAPE`.
    """

    image: Path
    camera: str
    scene: str
    stage: str
    objects: tuple[SeenObject, ...]
    present: tuple[str, ...]
    held: str | None

    @property
    def visible(self) -> list[str]:
        """Names of the clearly visible objects, from left to right."""
        return [o.name for o in sorted(self.objects, key=lambda o: o.box[0] + o.box[2]) if o.clear]

    @property
    def hidden(self) -> set[str]:
        """Names of objects that show too little for a yes or no."""
        return {o.name for o in self.objects if not o.clear}


def read_frames(folders: Sequence[Path], camera: str) -> list[Frame]:
    """Return all frames of a camera, in the order of folders and lines. Raises BadInput."""
    frames = [frame for folder in folders for frame in _frames_of(folder) if frame.camera == camera]
    if not frames:
        raise BadInput(f"no frame of the camera {camera} in {', '.join(map(str, folders))}")
    return frames


def _frames_of(folder: Path) -> list[Frame]:
    labels = _existing(folder / LABELS, "scenes")
    frames = []
    for number, line in enumerate(labels.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            frames.append(_frame(folder, json.loads(line)))
        except (KeyError, TypeError, ValueError) as error:
            raise BadInput(f"{labels}:{number}: {error!r}") from error
    return frames


def _frame(folder: Path, raw: JsonMap) -> Frame:
    things = raw["objects"]
    return Frame(
        image=folder / raw["file"],
        camera=raw["camera"],
        scene=str(raw["seed"]),
        stage=raw["stage"],
        objects=tuple(
            SeenObject(thing["name"], tuple(thing["box"]), thing["pixels"])
            for thing in things
            if thing["box"] is not None
        ),
        present=tuple(thing["name"] for thing in things),
        held=raw["held"],
    )


def vocabulary(frames: Sequence[Frame]) -> tuple[list[str], Words]:
    """Return all names of objects, and the words that they are made of, each sorted."""
    names = sorted({name for frame in frames for name in frame.present})
    parts = [name.split(" ", 1) for name in names]
    return names, (sorted({color for color, _ in parts}), sorted({shape for _, shape in parts}))


def split_by_scene(
    frames: Sequence[Frame], held_out: float, seed: int
) -> tuple[list[Frame], list[Frame]]:
    """Return (training, held-out) frames; whole scenes go to one side, at least one each."""
    scenes = sorted({frame.scene for frame in frames})
    if len(scenes) < 2:
        raise BadInput("a data set needs at least two scenes, or nothing can be held out")
    random.Random(f"split-{seed}").shuffle(scenes)
    count = min(len(scenes) - 1, max(1, round(len(scenes) * held_out)))
    away = set(scenes[:count])
    return [f for f in frames if f.scene not in away], [f for f in frames if f.scene in away]


def load_pixels(frames: Sequence[Frame], size: tuple[int, int]) -> Any:
    """Return a uint8 tensor (frames, 3, height, width), resized to `size` = (width, height)."""
    import numpy as np
    import torch
    from PIL import Image

    pixels: Any = np.empty((len(frames), size[1], size[0], 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        with Image.open(frame.image) as image:
            rgb = image.convert("RGB")
        fits = rgb.size == size
        pixels[index] = np.asarray(rgb if fits else rgb.resize(size, Image.Resampling.BICUBIC))
    return torch.from_numpy(pixels).permute(0, 3, 1, 2)


# -- tries
def write_tries(
    folder: Path,
    kind: str,
    lengths: Sequence[int],
    columns: Mapping[str, NDArray[Any]],
    **info: Any,
) -> None:
    """Write the steps of all tries, one after the other; `info` goes to `info.json`."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    for name, values in columns.items():
        np.save(folder / f"{name}.npy", values)
    text = json.dumps({"kind": kind, "lengths": list(lengths), **info}, indent=1)
    (folder / INFO).write_text(text + "\n", encoding="utf-8")


def read_tries(
    folders: Sequence[Path], kind: str, columns: Sequence[str]
) -> tuple[list[JsonObject], dict[str, NDArray[Any]]]:
    """Return `info.json` of each folder, and the columns of all in their order. Raises BadInput."""
    import numpy as np

    infos = [_info_of(folder, kind) for folder in folders]
    joined = {}
    for name in columns:
        parts = [np.load(_existing(folder / f"{name}.npy", kind)) for folder in folders]
        for folder, info, part in zip(folders, infos, parts, strict=True):
            if len(part) != sum(info["lengths"]):
                raise BadInput(
                    f"{folder / name}.npy has {len(part)} steps, "
                    f"the tries of {INFO} sum to {sum(info['lengths'])}"
                )
        joined[name] = np.concatenate(parts)
    return infos, joined


def _info_of(folder: Path, kind: str) -> JsonObject:
    path = _existing(folder / INFO, kind)
    try:
        info: JsonObject = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise BadInput(f"{path}: {error}") from error
    if info.get("kind") != kind:
        raise BadInput(f"{path} is of kind {info.get('kind')!r}, expected {kind!r}")
    return info


def _existing(path: Path, kind: str) -> Path:
    if not path.is_file():
        raise BadInput(
            f"{path} is missing: record with `python -m training record {kind} --count N "
            f"--out {path.parent}`"
        )
    return path
