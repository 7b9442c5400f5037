"""H.264 video of an episode: RGB pictures with a caption, encoded by ffmpeg on its own thread.

The control thread only hands a picture over: when the encoder is slow, pictures are dropped and
counted. Only a world that nothing else waits for (a benchmark) may `wait`, and misses none.
"""

from __future__ import annotations

import logging
import queue
import threading
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

QUEUE_MAX = 30  # pictures; two to three seconds of video
WAIT_S = 1.0  # between two looks whether the encoder is still there
LINE_PX = 22
FONT_SCALE = 0.5
ENCODING = ("-preset", "veryfast", "-crf", "26", "-threads", "1", "-movflags", "+faststart")


class VideoRecorder:
    """`VideoRecorder(path, fps)`; `submit(rgb, lines)` from one thread; `close()` finishes the
    file.

    H.264 wants even sizes: an odd last row or column is cut off.
    """

    def __init__(self, path: Path, *, fps: float, wait: bool = False) -> None:
        self.path = path
        self._wait = wait
        self.fps = fps
        self.written = 0
        self.dropped = 0
        self.error: str = ""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._queue: queue.Queue[tuple[Any, tuple[str, ...]] | None] = queue.Queue(
            maxsize=QUEUE_MAX
        )
        self._thread = threading.Thread(target=self._encode, name="recorder", daemon=True)
        self._thread.start()

    def submit(self, rgb: Any, lines: tuple[str, ...]) -> None:
        """Hand over one picture (uint8, height × width × 3); it must not be changed afterwards."""
        while True:
            try:
                self._queue.put((rgb, lines), block=self._wait, timeout=WAIT_S)
                return
            except queue.Full:
                if not self._wait or not self._thread.is_alive():
                    self.dropped += 1
                    return

    def close(self) -> None:
        """Encode what is queued, finish the file; repeatable."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _encode(self) -> None:
        writer: Any = None
        size: tuple[int, ...] = ()
        try:
            while (item := self._queue.get()) is not None:
                if self.error:
                    continue  # keep the queue moving: close() must not wait for a dead encoder
                rgb, lines = item
                rgb = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
                try:
                    if writer is None:
                        writer, size = self._open(rgb.shape[1], rgb.shape[0]), rgb.shape
                    if rgb.shape != size:  # ffmpeg counts bytes: all later ones would be garbled
                        raise RuntimeError(
                            f"the pictures were {size[1]} × {size[0]},"
                            f" now one is {rgb.shape[1]} × {rgb.shape[0]}"
                        )
                    writer.send(_caption(rgb, lines))
                    self.written += 1
                except (OSError, RuntimeError) as error:  # no ffmpeg, disk full: the robot goes on
                    self.error = str(error)
                    log.error("no video: %s", error)
        finally:
            if writer is not None:
                writer.close()
                if not self.error and not _whole(self.path):  # ffmpeg does not report errors
                    self.error = f"{self.path} could not be finished; is the disk full?"
                    log.error("no video: %s", self.error)

    def _open(self, width: int, height: int) -> Any:
        import imageio_ffmpeg  # type: ignore[import-untyped]

        writer = imageio_ffmpeg.write_frames(
            str(self.path),
            (width, height),
            fps=self.fps,
            codec="libx264",
            macro_block_size=2,
            output_params=list(ENCODING),
        )
        writer.send(None)
        return writer


def _whole(path: Path) -> bool:
    """Return whether an MP4 file has its index, and ends where its last part does."""
    try:
        with path.open("rb") as file:
            at, indexed, end = 0, False, path.stat().st_size
            while at < end:
                file.seek(at)
                head = file.read(16)
                size = int.from_bytes(head[:4])
                if size == 1:  # a large part: its size stands behind its name
                    size = int.from_bytes(head[8:16])
                if size < 8:
                    return False
                indexed |= head[4:8] == b"moov"
                at += size
            return indexed and at == end
    except OSError:
        return False


def _caption(rgb: Any, lines: tuple[str, ...]) -> Any:
    """Return a copy of the picture with the lines on a dark strip at the top."""
    import cv2
    import numpy as np

    if not lines:
        return np.ascontiguousarray(rgb)
    picture = rgb.copy()
    height = LINE_PX * len(lines) + 8
    picture[:height] //= 3
    for index, line in enumerate(lines):
        text = line.encode("ascii", "replace").decode()  # OpenCV's fonts know ASCII only
        cv2.putText(
            picture, text, (8, LINE_PX * (index + 1) - 2),
            cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, (255, 255, 255), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return picture
