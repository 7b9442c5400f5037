"""GStreamer pipelines as text, from a camera's description and the platform.

Pure: loads no GStreamer and looks at no machine. Every pipeline ends in an appsink named `sink`, to
which the reader gives format, depth and pacing. An operator's values are quoted: a path with a `!`
in it is a path, not another element.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import PurePath
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vram_arbiter.runner.params import Params
from vram_arbiter.runner.sensors.platform import Platform

SINK = "sink"
FPS_MAX = 1000.0
LATENCY_MAX_MS = 10_000
RTSP_TIMEOUT_S = (
    5  # a server that is silent for this long is gone; GStreamer's own 20 s suit films, not robots
)

Source = Literal["v4l2", "csi", "rtsp", "file", "test"]
Codec = Literal["raw", "mjpeg", "h264", "h265"]
Encoding = Literal["bgr8", "rgb8", "mono8", "depth16", "jpeg"]
Text = Annotated[str, Field(min_length=1, max_length=4096)]
Value = Annotated[str, Field(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f]+$")]
Pixels = Annotated[int, Field(gt=0, le=16_384)]


class GStreamerParams(Params, strict=True):
    """`backend_params` of `gstreamer`: either `pipeline`, or `source` and what goes with it."""

    pipeline: Text | None = None
    """A whole pipeline as for gst-launch-1.0.

    Without an appsink its end is converted and taken; one of its own must be named `sink`.
    """
    source: Source | None = None
    device: Value | None = None
    """v4l2: /dev/video0."""
    sensor_index: Annotated[int, Field(ge=0, le=15)] | None = None
    """csi: which camera of a Jetson's Argus, from 0."""
    url: Value | None = None
    """rtsp: rtsp:// or rtsps://. A user and password in it never show up in messages."""
    path: Value | None = None
    """file: .mp4, .m4v, .mov, .mkv, or .avi with mjpeg. Played at its own rate."""
    pattern: Value | None = None
    """test: what `videotestsrc` shows, `smpte` if not given."""
    codec: Codec | None = None
    """v4l2: raw if not given; rtsp and file: h264 if not given."""
    encoding: Encoding = "bgr8"
    """Encoding of the frames.

    `jpeg` passes on what an mjpeg camera sends; `depth16` (mm) is taken only from a depth device.
    """
    width: Pixels | None = None
    """v4l2, csi and test: asked of the source. rtsp and file: scaled to."""
    height: Pixels | None = None
    fps: Annotated[float, Field(gt=0, le=FPS_MAX, allow_inf_nan=False)] | None = None
    """v4l2, csi and test: asked of the source."""
    transport: Literal["tcp", "udp"] = "tcp"
    """rtsp: tcp loses no packet, udp is sooner there."""
    latency_ms: Annotated[int, Field(ge=0, le=LATENCY_MAX_MS)] = 100
    """rtsp: how long to wait for a packet that is missing or late."""
    loop: bool = False
    """file: begin again at the end."""
    platform: Literal["tegra", "nvidia_desktop", "cpu_only"] | None = None
    """Platform of the decoders; probed if not given."""

    @model_validator(mode="after")
    def _fits_the_source(self) -> Self:
        if (self.pipeline is None) == (self.source is None):
            raise ValueError("give either pipeline or source")
        kind = "pipeline" if self.source is None else self.source
        if (
            unneeded := self.model_fields_set
            - _NEEDED[kind]
            - _OPTIONAL[kind]
            - {kind, "source", "encoding"}
        ):
            raise ValueError(f"not for {kind}: {', '.join(sorted(unneeded))}")
        if missing := sorted(name for name in _NEEDED[kind] if getattr(self, name) is None):
            raise ValueError(f"source {kind} needs {', '.join(missing)}")
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height go together")
        if self.url is not None and not self.url.startswith(("rtsp://", "rtsps://")):
            raise ValueError("url begins with rtsp:// or rtsps://")
        self._check_formats()
        return self

    def _check_formats(self) -> None:
        if self.source is None:
            return
        if self.source in ("rtsp", "file") and self.codec == "raw":
            raise ValueError(
                f"source {self.source} carries mjpeg, h264 or h265;"
                " for anything else write a pipeline"
            )
        if self.path is not None:
            demuxer(self.path, self.codec_used)
        if self.source == "csi" and self.encoding in ("depth16", "jpeg"):
            raise ValueError(f"a CSI camera gives colors, not {self.encoding}")
        if self.encoding == "depth16" and (
            self.source not in ("v4l2", "test") or self.codec_used != "raw"
        ):
            raise ValueError(
                "depth16 is taken only from a raw v4l2 source: a decoded picture has no depth in it"
            )
        if self.encoding == "jpeg" and self.source != "test" and self.codec_used != "mjpeg":
            raise ValueError(
                "encoding jpeg hands on what the camera sends: it goes with codec mjpeg"
            )
        if self.encoding == "jpeg" and self.source in ("rtsp", "file") and self.width is not None:
            raise ValueError(
                "encoding jpeg hands pictures on as they are: leave width and height away"
            )

    @property
    def codec_used(self) -> Codec:
        """What comes from the source, named or by default."""
        return self.codec or ("h264" if self.source in ("rtsp", "file") else "raw")


_NEEDED: Mapping[str, frozenset[str]] = {
    "pipeline": frozenset(),
    "v4l2": frozenset({"device"}),
    "csi": frozenset({"sensor_index"}),
    "rtsp": frozenset({"url"}),
    "file": frozenset({"path"}),
    "test": frozenset(),
}
_OPTIONAL: Mapping[str, frozenset[str]] = {
    "pipeline": frozenset(),
    "v4l2": frozenset({"codec", "width", "height", "fps", "platform"}),
    "csi": frozenset({"width", "height", "fps"}),
    "rtsp": frozenset({"codec", "width", "height", "transport", "latency_ms", "platform"}),
    "file": frozenset({"codec", "width", "height", "loop", "platform"}),
    "test": frozenset({"pattern", "width", "height", "fps"}),
}

CAPS: Mapping[Encoding, str] = {
    "bgr8": "video/x-raw,format=BGR",
    "rgb8": "video/x-raw,format=RGB",
    "mono8": "video/x-raw,format=GRAY8",
    "depth16": "video/x-raw,format=GRAY16_LE",
    "jpeg": "image/jpeg",
}
"""What the appsink accepts, by the encoding of the frames."""

_COMPRESSED: Mapping[Codec, str] = {
    "mjpeg": "image/jpeg",
    "h264": "video/x-h264",
    "h265": "video/x-h265",
}
_DEPAY: Mapping[Codec, str] = {
    "mjpeg": "rtpjpegdepay",
    "h264": "rtph264depay",
    "h265": "rtph265depay",
}
_DEMUXERS = {
    ".mp4": "qtdemux",
    ".m4v": "qtdemux",
    ".mov": "qtdemux",
    ".mkv": "matroskademux",
    ".avi": "avidemux",
}
_DECODERS: Mapping[Platform, Mapping[Codec, str]] = {
    Platform.TEGRA: {
        "mjpeg": "nvv4l2decoder mjpeg=1",
        "h264": "h264parse ! nvv4l2decoder",
        "h265": "h265parse ! nvv4l2decoder",
    },
    # JPEG on the CPU: many cameras send 4:2:2, which the GPU's JPEG decoder refuses
    Platform.NVIDIA_DESKTOP: {
        "mjpeg": "jpegdec",
        "h264": "h264parse ! nvh264dec",
        "h265": "h265parse ! nvh265dec",
    },
    # no parser: depayloaders and demuxers give whole pictures already, and Debian keeps the parsers
    # in a large package
    Platform.CPU_ONLY: {"mjpeg": "jpegdec", "h264": "avdec_h264", "h265": "avdec_h265"},
}
CSI_CAPS = "video/x-raw(memory:NVMM),format=NV12"
_FROM_NVMM = ("nvvidconv", "video/x-raw,format=BGRx")
_LATEST_ONLY = "queue leaky=downstream max-size-buffers=1 max-size-bytes=0 max-size-time=0"


def quoted(text: str) -> str:
    """Quote a value for a pipeline's text."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def demuxer(path: str, codec: Codec) -> str:
    """Return the element that opens this kind of file. Raises ValueError for other kinds."""
    suffix = PurePath(path).suffix.lower()
    if suffix not in _DEMUXERS:
        raise ValueError(
            f"path must end in one of {', '.join(_DEMUXERS)}; for anything else write a pipeline"
        )
    if suffix == ".avi" and codec != "mjpeg":
        raise ValueError(
            f"an .avi file with {codec} says too little about its pictures; put it into .mp4"
        )
    return _DEMUXERS[suffix]


def framerate(fps: float) -> str:
    """Return GStreamer's fraction; 29.97 means 30000/1001."""
    for whole in (24, 30, 60, 120):
        if abs(fps - whole * 1000 / 1001) < 0.005:
            return f"{whole * 1000}/1001"
    rate = Fraction(fps).limit_denominator(1001)
    return f"{rate.numerator}/{rate.denominator}"


def build(params: GStreamerParams, platform: Platform) -> str:
    """Return one camera's pipeline.

    `platform` (unless the parameters name one) chooses the elements.
    """
    if params.pipeline is not None:
        if re.search(r"\bappsink\b", params.pipeline):
            return params.pipeline
        return " ! ".join([params.pipeline, *_convert(params), _sink()])
    if params.platform is not None:
        platform = Platform(params.platform)
    return " ! ".join([*_source(params), *_decode(params, platform), *_convert(params), _sink()])


def _sink() -> str:
    return f"appsink name={SINK}"


def _size(params: GStreamerParams) -> str:
    return "" if params.width is None else f",width={params.width},height={params.height}"


def _asked(params: GStreamerParams) -> str:
    return _size(params) + (f",framerate={framerate(params.fps)}" if params.fps is not None else "")


def _source(params: GStreamerParams) -> list[str]:
    codec = params.codec_used
    if params.source == "v4l2":
        form = (
            CAPS["depth16"]
            if params.encoding == "depth16"
            else _COMPRESSED.get(codec, "video/x-raw")
        )
        return [f"v4l2src device={quoted(params.device or '')}", form + _asked(params)]
    if params.source == "csi":
        # Argus gives NV12 in NVMM memory; the engine that copies it out converts as well
        return [
            f"nvarguscamerasrc sensor-id={params.sensor_index}",
            f"{CSI_CAPS}{_asked(params)}",
            _LATEST_ONLY,
            *_FROM_NVMM,
        ]
    if params.source == "rtsp":
        microseconds = RTSP_TIMEOUT_S * 1_000_000
        head = (
            f"rtspsrc location={quoted(params.url or '')} protocols={params.transport}"
            f" latency={params.latency_ms}"
        )
        return [f"{head} timeout={microseconds} tcp-timeout={microseconds}", _DEPAY[codec]]
    if params.source == "file":
        return [f"filesrc location={quoted(params.path or '')}", demuxer(params.path or "", codec)]
    form = CAPS["depth16"] if params.encoding == "depth16" else "video/x-raw"
    head = f"videotestsrc is-live=true pattern={quoted(params.pattern or 'smpte')}"
    return [head, form + _asked(params), *(["jpegenc"] if params.encoding == "jpeg" else [])]


def _decode(params: GStreamerParams, platform: Platform) -> list[str]:
    codec = params.codec_used
    if codec == "raw" or params.encoding == "jpeg":
        return []
    scaled = _size(params) if params.source in ("rtsp", "file") else ""
    elements = [_DECODERS[platform][codec]]
    if params.source != "file":
        elements.append(_LATEST_ONLY)  # a slow converter loses pictures instead of falling behind
    if platform is Platform.TEGRA:
        # only there are decoded pictures in NVMM memory; the engine that copies them out scales as
        # well
        copied, form = _FROM_NVMM
        elements += [copied, form + scaled]
    elif scaled:
        elements += ["videoscale", f"video/x-raw{scaled}"]
    return elements


def _convert(params: GStreamerParams) -> list[str]:
    """Convert to the requested colors.

    Nothing is converted to depth: gray values are not distances.
    """
    return [] if params.encoding in ("depth16", "jpeg") else ["videoconvert"]
