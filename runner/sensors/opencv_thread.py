"""Cameras by OpenCV: a local device, a video file, or a stream by URL (RTSP). One thread each.

OpenCV works with one thread inside (`cv2.setNumThreads(1)`): the cores belong to the control loop
and the models. A device or a stream that breaks is reopened, a bounded number of times and ever
more slowly; a file is paced at its own rate and ends.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit, urlunsplit

from pydantic import Field, model_validator

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.params import Params, read_params, wrong
from vram_arbiter.runner.sensors.lag import LagMeter
from vram_arbiter.runner.sensors.slot import BROKE_DOWN, Feed, FrameTee, SlotReader, ThreadReader
from vram_arbiter.schemas.config.robot import SensorReaderConfig
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

FPS_MAX = 1000.0
RECONNECT_MAX_S = 8.0  # the pause between two tries doubles up to this
URL_SCHEMES = ("rtsp", "rtsps")

Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]
Pixels = Annotated[int, Field(gt=0, le=16_384)]


class OpenCvParams(Params, strict=True):
    """`backend_params` of `opencv_thread`: one of `device`, `path` and `url`, and their options."""

    device: Annotated[int, Field(ge=0, le=255)] | None = None
    """Number of a camera of this machine: 0 is /dev/video0."""
    path: Annotated[str, Field(min_length=1)] | None = None
    """A video file, played at its own rate."""
    url: Annotated[str, Field(min_length=1)] | None = None
    """A stream: rtsp:// or rtsps://. A user and password in it never show up in messages."""
    encoding: Literal["bgr8", "rgb8", "mono8"] = "bgr8"
    width: Pixels | None = None
    """Devices: ask for this size; what the camera really gives is what the frames say."""
    height: Pixels | None = None
    fps: Annotated[float, Field(gt=0, le=FPS_MAX, allow_inf_nan=False)] | None = None
    """Devices: ask for this rate. Files: play at this one instead of the file's own."""
    fourcc: Annotated[str, Field(min_length=4, max_length=4)] | None = None
    """Devices: ask for this format, such as MJPG."""
    loop: bool = False
    """Files: begin again at the end."""
    reconnect_tries: Annotated[int, Field(ge=0, le=100_000)] = 10
    """Devices and URLs: so many failures in a row end the camera."""
    reconnect_s: Seconds = 0.25
    """Devices and URLs: pause before the first new try."""
    stamp: Literal["source", "arrival"] = "source"
    """Devices and URLs: start of a picture's age.

    `source` adds the time that it waited in a queue, by the source's own stamps; `arrival` is for
    sources whose stamps are wrong.
    """
    timeout_s: Seconds = 5.0
    """URLs: the longest that opening, or waiting for a picture, may take."""

    @model_validator(mode="after")
    def _fits_the_source(self) -> Self:
        given = [name for name in ("device", "path", "url") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"give one of device, path and url, not {' and '.join(given) or 'none'}"
            )
        unneeded = self.model_fields_set - _NEEDED[given[0]] - {given[0], "encoding"}
        if unneeded:
            raise ValueError(f"not for a {given[0]}: {', '.join(sorted(unneeded))}")
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height go together")
        if self.url is not None and urlsplit(self.url).scheme not in URL_SCHEMES:
            raise ValueError(
                f"url begins with one of {', '.join(f'{name}://' for name in URL_SCHEMES)}"
            )
        return self

    @property
    def label(self) -> str:
        """How messages call the source."""
        if self.device is not None:
            return f"device {self.device}"
        return self.path if self.path is not None else without_credentials(self.url or "")


_NEEDED = {
    "device": {"width", "height", "fps", "fourcc", "stamp", "reconnect_tries", "reconnect_s"},
    "path": {"fps", "loop"},
    "url": {"stamp", "reconnect_tries", "reconnect_s", "timeout_s"},
}


def without_credentials(url: str) -> str:
    """Return the URL for a log: without user, password and query."""
    parts = urlsplit(url)
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def make(config: SensorReaderConfig, clock: Clock, tee: FrameTee | None) -> SlotReader:
    """Return a reader, not started.

    Raises ConfigError: wrong parameters, missing file, missing OpenCV.
    """
    params = read_params(OpenCvParams, config.backend_params, "backend_params")
    need(config.backend, "cv2", extra="runner")
    if params.path is not None and not Path(params.path).is_file():
        raise wrong("backend_params.path", f"file not found: {params.path}")
    return OpenCvReader(config.sensor_id, config.max_age_ms, params, clock, tee)


class OpenCvReader(ThreadReader):
    """One camera on a thread of its own, which alone touches its `cv2.VideoCapture`."""

    def __init__(
        self,
        sensor_id: str,
        max_age_ms: float,
        params: OpenCvParams,
        clock: Clock,
        tee: FrameTee | None = None,
    ) -> None:
        super().__init__(sensor_id, max_age_ms, clock, tee)
        self._params = params

    def _run_begins(self, feed: Feed) -> None:
        self._begin(lambda stopping: self._run(feed, stopping))

    # -- on the camera's thread
    def _run(self, feed: Feed, stopping: threading.Event) -> None:
        import cv2

        cv2.setNumThreads(1)
        try:
            if self._params.path is not None:
                self._play(cv2, feed, stopping)
            else:
                self._watch(cv2, feed, stopping)
        finally:
            feed.end(BROKE_DOWN)  # if nothing else was said before

    def _watch(self, cv2: Any, feed: Feed, stopping: threading.Event) -> None:
        """Read a device or a stream until it breaks off, and open it again."""
        params, failures = self._params, 0
        while True:
            capture = self._open(cv2)
            opened, taken = capture.isOpened(), 0
            lag = LagMeter() if params.stamp == "source" else None
            try:
                while (
                    opened
                    and not stopping.is_set()
                    and (frame := self._take(cv2, capture, lag)) is not None
                ):
                    self.deliver(feed, frame)
                    taken += 1
            finally:
                capture.release()
            if stopping.is_set():
                return
            failures = 1 if taken else failures + 1
            problem = "broke off" if taken else "gives no picture" if opened else "cannot be opened"
            if failures > params.reconnect_tries:
                feed.end(
                    f"{params.label} {problem}, given up after {params.reconnect_tries} new tries"
                )
                return
            feed.interrupt(
                f"{params.label} {problem}, new try {failures} of {params.reconnect_tries}"
            )
            if stopping.wait(min(params.reconnect_s * 2 ** min(failures - 1, 16), RECONNECT_MAX_S)):
                return

    def _play(self, cv2: Any, feed: Feed, stopping: threading.Event) -> None:
        """Play a file at its own pace.

        A late picture shifts the rest, nothing is caught up in a burst.
        """
        params = self._params
        while True:
            capture = self._open(cv2)
            taken = 0
            try:
                if not capture.isOpened():
                    feed.end(f"{params.label} cannot be read as a video")
                    return
                fps = params.fps if params.fps is not None else float(capture.get(cv2.CAP_PROP_FPS))
                if not 0 < fps <= FPS_MAX:
                    feed.end(f"{params.label} names no rate to play it at; give fps")
                    return
                due_s = self.clock.now_s()
                while not stopping.is_set() and (frame := self._take(cv2, capture)) is not None:
                    self.deliver(feed, frame)
                    taken += 1
                    due_s = max(due_s + 1 / fps, self.clock.now_s())
                    stopping.wait(
                        due_s - self.clock.now_s()
                    )  # the last picture, too, stays for its time
            finally:
                capture.release()
            if stopping.is_set():
                return
            if not taken or not params.loop:
                feed.end(f"{params.label} is over after {taken} pictures")
                return

    def _open(self, cv2: Any) -> Any:
        params = self._params
        capture = cv2.VideoCapture()
        if params.device is not None:
            if capture.open(params.device):
                self._ask(cv2, capture)
        elif params.path is not None:
            capture.open(params.path)
        else:
            timeout_ms = round(params.timeout_s * 1e3)
            capture.open(
                params.url,
                cv2.CAP_FFMPEG,
                [
                    cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                    timeout_ms,
                    cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                    timeout_ms,
                ],
            )
        return capture

    def _ask(self, cv2: Any, capture: Any) -> None:
        params = self._params
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a driver's queue only makes pictures older
        if params.fourcc is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*params.fourcc))
        if params.width is not None and params.height is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, params.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, params.height)
        if params.fps is not None:
            capture.set(cv2.CAP_PROP_FPS, params.fps)

    def _take(self, cv2: Any, capture: Any, lag: LagMeter | None = None) -> SensorFrame | None:
        """Return the next picture, stamped when it was taken as far as `lag` knows, else on
        arrival.

        None if there is none.
        """
        if not capture.grab():
            return None
        arrival_ns, wall_ns = self.clock.now_ns(), self.clock.wall_ns()
        stamp_ns = arrival_ns
        if lag is not None:
            stamp_ns = max(0, lag.taken_ns(arrival_ns, float(capture.get(cv2.CAP_PROP_POS_MSEC))))
        done, image = capture.retrieve()
        if not done or image is None or not image.size:
            return None
        image = as_encoding(cv2, image, self._params.encoding)
        height, width = image.shape[:2]
        return SensorFrame(
            sensor_id=self.sensor_id,
            stamp_monotonic_ns=stamp_ns,
            stamp_wall_ns=wall_ns - (arrival_ns - stamp_ns),
            encoding=FrameEncoding(self._params.encoding),
            width=int(width),
            height=int(height),
            channels=1 if image.ndim == 2 else int(image.shape[2]),
            data=image.tobytes(),
        )


def as_encoding(cv2: Any, image: Any, encoding: Literal["bgr8", "rgb8", "mono8"]) -> Any:
    """Return an 8-bit picture of OpenCV (gray, or blue-green-red) in the layout of `encoding`."""
    grey = image.ndim == 2 or image.shape[2] == 1
    if encoding == "mono8":
        return image.reshape(image.shape[:2]) if grey else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    return image if encoding == "bgr8" else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
