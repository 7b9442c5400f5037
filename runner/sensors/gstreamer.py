"""Cameras by GStreamer: devices, streams and files with hardware decoders, or any pipeline.

One thread per camera, which alone touches its pipeline. Frames carry the time at which the picture
was taken, as far as the source gives it. GStreamer is loaded when a reader is made, never by
importing this module.
"""

from __future__ import annotations

import ctypes
import logging
import re
import threading
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.params import read_params, wrong
from vram_arbiter.runner.sensors.pipelines import CAPS, SINK, GStreamerParams, build
from vram_arbiter.runner.sensors.platform import probe_platform
from vram_arbiter.runner.sensors.slot import (
    BROKE_DOWN,
    STOP_S,
    Feed,
    FrameTee,
    SlotReader,
    ThreadReader,
)
from vram_arbiter.schemas.config.robot import SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError, FrameStale
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

log = logging.getLogger(__name__)

START_S = (
    10.0  # the longest that opening a source and, for a file, decoding its first picture may take
)
CLOCK_LOOKS = 5  # at both clocks, to know how far apart they are: the closest pair counts
POLL_NS = 50_000_000  # how soon a stop or an error of a source without pictures is noticed
NANOSECONDS_MAX = 2**64 - 1  # GStreamer's word for "no time known"

PACKAGES = {
    "avdec_h264": "gstreamer1.0-libav",
    "avdec_h265": "gstreamer1.0-libav",
    "h264parse": "gstreamer1.0-plugins-bad",
    "h265parse": "gstreamer1.0-plugins-bad",
    "nvh264dec": "gstreamer1.0-plugins-bad and the GPU's driver",
    "nvh265dec": "gstreamer1.0-plugins-bad and the GPU's driver",
    "nvv4l2decoder": "nvidia-l4t-gstreamer",
    "nvarguscamerasrc": "nvidia-l4t-gstreamer; only a Jetson has it",
    "nvvidconv": "nvidia-l4t-gstreamer",
    "rtspsrc": "gstreamer1.0-plugins-good",
    "v4l2src": "gstreamer1.0-plugins-good",
}
"""Element → what brings it, in Debian's names."""

_BYTES = {"bgr8": 3, "rgb8": 3, "mono8": 1, "depth16": 2}


@dataclass(frozen=True, slots=True)
class Libraries:
    """The namespaces of GLib and GStreamer that are used here."""

    glib: Any
    gst: Any
    app: Any
    video: Any


def load() -> Libraries:
    """GStreamer, initialised. Raises ConfigError that says what to install."""
    _keep_unwinding()
    try:
        import gi

        gi.require_version("Gst", "1.0")
        gi.require_version("GstApp", "1.0")
        gi.require_version("GstVideo", "1.0")
        from gi.repository import GLib, Gst, GstApp, GstVideo
    except (
        ImportError,
        ValueError,
    ) as error:  # ValueError: its word for a description that is not installed
        raise ConfigError(
            f"GStreamer cannot be used here: {error}",
            hint="Debian, Ubuntu: install the system's packages that docs/how-to/cameras.md names,"
            " then pip install 'vram-arbiter[gstreamer]'",
        ) from error
    if not Gst.is_initialized():
        Gst.init(None)
    return Libraries(GLib, Gst, GstApp, GstVideo)


def _keep_unwinding() -> None:
    """Let C++ exceptions unwind by libgcc.

    Debian's GStreamer brings libunwind, whose functions have the same names; the next library that
    throws (matplotlib's, OpenCV's) would end the process. The first one in the global scope is
    used.
    """
    try:
        ctypes.CDLL("libgcc_s.so.1", mode=ctypes.RTLD_GLOBAL)
    except OSError as error:  # a system without GNU's compiler library has no such clash
        log.debug("no libgcc_s: %s", error)


def make(config: SensorReaderConfig, clock: Clock, tee: FrameTee | None) -> SlotReader:
    """Return a reader, not started.

    Raises ConfigError: wrong parameters, GStreamer or an element missing, an invalid pipeline.
    """
    params = read_params(GStreamerParams, config.backend_params, "backend_params")
    if params.path is not None and not Path(params.path).is_file():
        raise wrong("backend_params.path", f"file not found: {params.path}")
    libraries = load()
    text = build(params, probe_platform())
    try:
        _parse(
            libraries, text
        )  # opens nothing; a typing error is said now, not when the robot is on
    except ValueError as error:
        field = "pipeline" if params.pipeline is not None else "source"
        raise wrong(f"backend_params.{field}", str(error)) from error
    return GStreamerReader(config.sensor_id, config.max_age_ms, params, text, clock, tee)


def without_credentials(text: str) -> str:
    """Return a message of GStreamer without the users and passwords of its URLs."""
    return re.sub(r"(?<=://)[^/\s@\"']+@", "", text)


def _parse(libraries: Libraries, text: str) -> tuple[Any, Any]:
    """Return the pipeline and its appsink. Raises ValueError with a message for the operator."""
    gst = libraries.gst
    try:
        pipeline = gst.parse_launch_full(text, None, gst.ParseFlags.FATAL_ERRORS)
    except libraries.glib.Error as error:
        raise ValueError(_explain(str(error.message))) from error
    sink = pipeline.get_by_name(SINK) if isinstance(pipeline, gst.Bin) else None
    if not isinstance(sink, libraries.app.AppSink):
        raise ValueError(
            f"the pipeline has no appsink named {SINK}: end it with `appsink name={SINK}`,"
            " or without an appsink"
        )
    return pipeline, sink


def _explain(problem: str) -> str:
    problem = without_credentials(problem)
    found = re.search(r'no element "([^"]+)"', problem)
    if found is None:
        return problem
    package = PACKAGES.get(found[1])
    advice = f"install {package}" if package else "gst-inspect-1.0 lists what is installed"
    if found[1].startswith(("nvh", "nvv", "h26")):
        advice += ", or say platform: cpu_only to decode on the CPU"
    return f"{problem}; {advice}"


class GStreamerReader(ThreadReader):
    """One camera through GStreamer.

    A source that ends or breaks ends the reader with GStreamer's reason.
    """

    def __init__(
        self,
        sensor_id: str,
        max_age_ms: float,
        params: GStreamerParams,
        text: str,
        clock: Clock,
        tee: FrameTee | None = None,
    ) -> None:
        super().__init__(sensor_id, max_age_ms, clock, tee)
        self._text = text
        self.decodes_on_gpu = re.search(r"\bnv\w+dec\b", text) is not None
        self._params = params

    def _run_begins(self, feed: Feed) -> None:
        """Wait until the source is open; for a file, until its first picture is decoded.

        Raises FrameStale.
        """
        opened: Future[None] = Future()
        self._begin(lambda stopping: self._run(feed, opened, stopping))
        try:
            opened.result(START_S + STOP_S)
        except TimeoutError:
            self._give_up(feed, f"its driver has not answered for {START_S + STOP_S:.0f} s")
        except _Broken as error:
            self._give_up(feed, str(error))

    def _give_up(self, feed: Feed, reason: str) -> None:
        self._stopping.set()
        feed.end(reason)
        raise FrameStale(
            f"camera {self.sensor_id} cannot be opened: {reason}",
            hint="look at the camera and its backend_params, then start again",
            details={"sensor_id": self.sensor_id, "reason": reason, "ended": True},
        )

    # -- on the camera's thread
    def _run(self, feed: Feed, opened: Future[None], stopping: threading.Event) -> None:
        run = None
        try:
            run = _Run(load(), self._text, self._params, self.sensor_id, self.clock)
            run.open()
            opened.set_result(None)
            while not stopping.is_set():
                frame = run.next_frame()
                if frame is not None:
                    self.deliver(feed, frame)
        except _Broken as error:
            feed.end(str(error))
            if not opened.done():
                opened.set_exception(error)
        finally:
            feed.end(BROKE_DOWN)  # if nothing else was said before
            if not opened.done():
                opened.set_exception(_Broken(BROKE_DOWN))
            if run is not None:
                run.close()


class _Broken(Exception):
    """The source ended or broke; the text says how, for people."""


class _Run:
    """One life of one pipeline, on one thread."""

    def __init__(
        self, libraries: Libraries, text: str, params: GStreamerParams, sensor_id: str, clock: Clock
    ) -> None:
        self._libraries, self._params = libraries, params
        self._sensor_id, self._clock = sensor_id, clock
        self._gst = libraries.gst
        self._over = False
        try:
            self._pipeline, self._sink = _parse(libraries, text)
        except ValueError as error:
            raise _Broken(str(error)) from error
        # the machine's monotonic clock, so that times of buffers become times of the runner
        self._time = self._gst.SystemClock.obtain()
        self._pipeline.use_clock(self._time)
        self._ahead_ns = self._clocks_apart_ns()
        self._bus = self._pipeline.get_bus()
        self._wanted = self._gst.MessageType.ERROR | self._gst.MessageType.EOS
        self._sink.set_property("caps", self._gst.Caps.from_string(CAPS[params.encoding]))
        self._sink.set_property("max-buffers", 1)
        self._sink.set_property("drop", True)

    def open(self) -> None:
        """Bring it to running. Raises _Broken with GStreamer's reason."""
        gst = self._gst
        begun = self._pipeline.set_state(gst.State.PAUSED)
        if begun == gst.StateChangeReturn.ASYNC:
            begun = self._pipeline.get_state(round(START_S * 1e9))[0]
        if begun == gst.StateChangeReturn.FAILURE:
            raise _Broken(self._problem() or "the pipeline does not start")
        if begun == gst.StateChangeReturn.ASYNC:
            raise _Broken(self._problem() or f"it has given no picture within {START_S:.0f} s")
        # a live source sets the pace itself and its pictures are needed at once; a recording is
        # played at its own pace
        self._sink.set_property("sync", begun != gst.StateChangeReturn.NO_PREROLL)
        if self._pipeline.set_state(gst.State.PLAYING) == gst.StateChangeReturn.FAILURE:
            raise _Broken(self._problem() or "the pipeline does not play")

    def next_frame(self) -> SensorFrame | None:
        """Return the newest picture, or None after a while without one or for a damaged one.

        Raises _Broken when there will be no more.
        """
        sample = self._sink.try_pull_sample(POLL_NS)
        # at the end there is nothing to wait for at the sink, so wait at the bus
        at_end = sample is None and self._sink.is_eos()
        message = self._bus.timed_pop_filtered(POLL_NS if at_end else 0, self._wanted)
        if message is not None and message.type == self._gst.MessageType.ERROR:
            raise _Broken(_words(message))
        self._over |= (
            message is not None
        )  # may come before the last picture was taken out of the sink
        if sample is not None:
            return self._frame(sample)
        if self._over and self._params.loop:
            self._over = False
            flags = self._gst.SeekFlags.FLUSH | self._gst.SeekFlags.KEY_UNIT
            if not self._pipeline.seek_simple(self._gst.Format.TIME, flags, 0):
                raise _Broken("the file is over and cannot be played from its beginning again")
        elif self._over or (at_end and not self._params.loop):
            raise _Broken("the stream is over")
        return None

    def close(self) -> None:
        self._pipeline.set_state(self._gst.State.NULL)

    def _problem(self) -> str | None:
        message = self._bus.timed_pop_filtered(0, self._gst.MessageType.ERROR)
        return None if message is None else _words(message)

    def _frame(self, sample: Any) -> SensorFrame | None:
        gst, encoding = self._gst, self._params.encoding
        buffer, caps = sample.get_buffer(), sample.get_caps()
        if buffer.has_flags(gst.BufferFlags.CORRUPTED) or buffer.has_flags(gst.BufferFlags.GAP):
            return None  # half a picture, or one that was made up to fill a hole
        now_ns, wall_ns = self._clock.now_ns(), self._clock.wall_ns()
        taken_ns = self._taken_ns(sample.get_segment(), buffer, now_ns)
        if encoding == "jpeg":
            shape = caps.get_structure(0)
            (wide, width), (high, height) = shape.get_int("width"), shape.get_int("height")
            if not (wide and high):
                raise _Broken("its JPEG pictures do not say how large they are")
            data = buffer.extract_dup(0, buffer.get_size())
        else:
            width, height, data = self._pixels(caps, buffer, _BYTES[encoding])
        return SensorFrame(
            sensor_id=self._sensor_id,
            stamp_monotonic_ns=taken_ns,
            stamp_wall_ns=wall_ns - (now_ns - taken_ns),
            encoding=FrameEncoding(encoding),
            width=width,
            height=height,
            channels=1 if encoding in ("mono8", "depth16") else 3,
            data=data,
        )

    def _pixels(self, caps: Any, buffer: Any, pixel_bytes: int) -> tuple[int, int, bytes]:
        """Width, height and the rows without the bytes that GStreamer pads them with."""
        video = self._libraries.video
        info = video.VideoInfo.new_from_caps(caps)
        if info is None:
            raise _Broken(f"its pictures cannot be understood: {caps.to_string()}")
        # a decoder may lay its rows out differently from the format's rule, and says so in the
        # buffer
        meta = video.buffer_get_video_meta(buffer) or info
        stride, offset, row = meta.stride[0], meta.offset[0], info.width * pixel_bytes
        data = buffer.extract_dup(0, buffer.get_size())
        if stride < row or offset + stride * (info.height - 1) + row > len(data):
            raise _Broken(
                f"a picture of {info.width} × {info.height} came with {len(data)} bytes only"
            )
        if stride == row:
            return info.width, info.height, data[offset : offset + row * info.height]
        view = memoryview(data)
        starts = range(offset, offset + stride * info.height, stride)
        return info.width, info.height, b"".join(view[start : start + row] for start in starts)

    def _clocks_apart_ns(self) -> int:
        """Return the runner's clock minus GStreamer's.

        Measured once: a thread that is preempted between reading both clocks would make a picture
        look younger than it is.
        """
        looks = []
        for _ in range(CLOCK_LOOKS):
            before_ns, theirs_ns = self._clock.now_ns(), int(self._time.get_time())
            looks.append((self._clock.now_ns() - before_ns, before_ns - theirs_ns))
        return min(looks)[1]

    def _taken_ns(self, segment: Any, buffer: Any, now_ns: int) -> int:
        """Return when the picture was taken, on the runner's clock; `now_ns` without a usable
        stamp.
        """
        running = segment.to_running_time(self._gst.Format.TIME, buffer.pts)
        base = self._pipeline.get_base_time()
        if NANOSECONDS_MAX in (buffer.pts, running, base):
            return now_ns
        return min(now_ns, int(base + running) + self._ahead_ns)


def _words(message: Any) -> str:
    """Describe an error of GStreamer: element, message, and the internal part (file names,
    lines).
    """
    error, debug = message.parse_error()
    reason = debug.rpartition("\n")[2].strip() if debug and "\n" in debug else ""
    text = f"{message.src.get_name()}: {error.message.strip()}" + (f" ({reason})" if reason else "")
    return without_credentials(text)
