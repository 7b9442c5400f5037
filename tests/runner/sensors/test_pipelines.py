"""The text of a camera's pipeline, for each platform, and what is refused before anything is
opened.
"""

from typing import Any

import pytest
from pydantic import ValidationError

from vram_arbiter.runner.sensors.pipelines import GStreamerParams, build, framerate
from vram_arbiter.runner.sensors.platform import Platform


def text(on: Platform = Platform.CPU_ONLY, **params: Any) -> str:
    return build(GStreamerParams(**params), on)


def refusal(**params: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        GStreamerParams(**params)
    return "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in caught.value.errors())


def test_a_raw_camera() -> None:
    assert text(source="v4l2", device="/dev/video2", width=640, height=480, fps=30) == (
        'v4l2src device="/dev/video2" ! video/x-raw,width=640,height=480,framerate=30/1 !'
        " videoconvert ! appsink name=sink"
    )


def test_a_csi_camera_of_a_jetson() -> None:
    assert text(source="csi", sensor_index=1, width=1280, height=720, fps=60) == (
        "nvarguscamerasrc sensor-id=1 !"
        " video/x-raw(memory:NVMM),format=NV12,width=1280,height=720,framerate=60/1 !"
        " queue leaky=downstream max-size-buffers=1 max-size-bytes=0 max-size-time=0 !"
        " nvvidconv ! video/x-raw,format=BGRx ! videoconvert ! appsink name=sink"
    )
    assert "source csi needs sensor_index" in refusal(source="csi")
    assert "not for csi: device" in refusal(source="csi", sensor_index=0, device="/dev/video0")
    assert "gives colors, not jpeg" in refusal(source="csi", sensor_index=0, encoding="jpeg")


H264_FILE = {"source": "file", "path": "/data/run.mp4"}


@pytest.mark.parametrize(
    ("platform", "expected"),
    [
        (Platform.CPU_ONLY, "qtdemux ! avdec_h264 ! videoconvert"),
        (Platform.NVIDIA_DESKTOP, "qtdemux ! h264parse ! nvh264dec ! videoconvert"),
        (
            Platform.TEGRA,
            (
                "qtdemux ! h264parse ! nvv4l2decoder ! nvvidconv ! video/x-raw,format=BGRx !"
                " videoconvert"
            ),
        ),
    ],
)
def test_an_h264_file(platform: Platform, expected: str) -> None:
    assert (
        text(platform, **H264_FILE)
        == f'filesrc location="/data/run.mp4" ! {expected} ! appsink name=sink'
    )


ALL_SOURCES: list[dict[str, Any]] = [
    {"source": "v4l2", "device": "/dev/video0"},
    *(
        {"source": "v4l2", "device": "/dev/video0", "codec": codec}
        for codec in ("mjpeg", "h264", "h265")
    ),
    *(
        {"source": "rtsp", "url": "rtsp://cam/1", "codec": codec}
        for codec in ("mjpeg", "h264", "h265")
    ),
    *({"source": "file", "path": "a.mkv", "codec": codec} for codec in ("mjpeg", "h264", "h265")),
    {"source": "file", "path": "a.mp4", "width": 320, "height": 240},
    {"source": "test"},
    {"pipeline": "videotestsrc"},
]


@pytest.mark.parametrize("params", ALL_SOURCES)
def test_nothing_of_nvidias_closed_sdk_on_a_pc(params: dict[str, Any]) -> None:
    """The reference's first builder put nvvideoconvert and NVMM there; only DeepStream and Tegra
    have them.
    """
    made = text(Platform.NVIDIA_DESKTOP, **params)
    assert "nvvideoconvert" not in made
    assert "nvvidconv" not in made
    assert "NVMM" not in made
    assert "nvv4l2decoder" not in made


@pytest.mark.parametrize("params", ALL_SOURCES)
def test_nothing_of_nvidias_without_nvidia(params: dict[str, Any]) -> None:
    made = text(Platform.CPU_ONLY, **params)
    assert not [word for word in made.split() if word.startswith("nv")]


def test_the_platform_can_be_chosen() -> None:
    assert "avdec_h264" in text(Platform.NVIDIA_DESKTOP, **H264_FILE, platform="cpu_only")


def test_a_stream_loses_pictures_instead_of_falling_behind() -> None:
    made = text(source="rtsp", url="rtsp://user:word@cam/1", transport="udp", latency_ms=40)
    assert made == (
        'rtspsrc location="rtsp://user:word@cam/1" protocols=udp latency=40 timeout=5000000'
        " tcp-timeout=5000000 ! rtph264depay"
        " ! avdec_h264 ! queue leaky=downstream max-size-buffers=1 max-size-bytes=0 max-size-time=0"
        " ! videoconvert ! appsink name=sink"
    )


def test_a_file_is_scaled_by_what_the_platform_has() -> None:
    assert "avdec_h264 ! videoscale ! video/x-raw,width=320,height=240 !" in text(
        **H264_FILE, width=320, height=240
    )
    tegra = text(Platform.TEGRA, **H264_FILE, width=320, height=240)
    assert "nvvidconv ! video/x-raw,format=BGRx,width=320,height=240 !" in tegra
    assert "videoscale" not in tegra


def test_jpeg_is_handed_on_as_it_is() -> None:
    made = text(source="v4l2", device="/dev/video0", codec="mjpeg", encoding="jpeg", fps=29.97)
    assert (
        made == 'v4l2src device="/dev/video0" ! image/jpeg,framerate=30000/1001 ! appsink name=sink'
    )


def test_depth_is_never_made_out_of_grey() -> None:
    made = text(source="v4l2", device="/dev/video0", encoding="depth16")
    assert made == 'v4l2src device="/dev/video0" ! video/x-raw,format=GRAY16_LE ! appsink name=sink'
    assert "videoconvert" not in text(pipeline="v4l2src ! video/x-raw", encoding="depth16")
    assert "no depth in it" in refusal(**H264_FILE, encoding="depth16")


def test_a_path_is_a_value_whatever_is_in_it() -> None:
    assert r'location="/a \"b\" ! fakesink \\ x.mp4" ! qtdemux' in text(
        source="file", path='/a "b" ! fakesink \\ x.mp4'
    )


def test_an_operators_pipeline_keeps_its_own_sink() -> None:
    own = "videotestsrc ! tee name=t  t. ! queue ! appsink name=sink  t. ! fakesink"
    assert text(pipeline=own) == own
    assert text(pipeline="videotestsrc") == "videotestsrc ! videoconvert ! appsink name=sink"


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({}, "give either pipeline or source"),
        ({"source": "test", "pipeline": "videotestsrc"}, "give either pipeline or source"),
        ({"source": "v4l2"}, "source v4l2 needs device"),
        ({"source": "v4l2", "device": "/dev/video0", "loop": True}, "not for v4l2: loop"),
        (
            {"source": "rtsp", "url": "rtsp://c", "fps": 30.0, "path": "x"},
            "not for rtsp: fps, path",
        ),
        ({"pipeline": "videotestsrc", "width": 3}, "not for pipeline: width"),
        ({"source": "test", "width": 64}, "width and height go together"),
        ({"source": "rtsp", "url": "http://cam"}, "url begins with rtsp://"),
        ({"source": "file", "path": "a.h264"}, "path must end in one of .mp4"),
        ({"source": "file", "path": "a.avi"}, "put it into .mp4"),
        ({"source": "file", "path": "a.mp4", "codec": "raw"}, "carries mjpeg, h264 or h265"),
        (
            {"source": "v4l2", "device": "/dev/video0", "encoding": "jpeg"},
            "it goes with codec mjpeg",
        ),
        ({"source": "v4l2", "device": "/dev/video\n0"}, "device: "),
        ({"source": "usb"}, "source: "),
        ({"source": "test", "fps": float("nan")}, "fps: "),
        ({"source": "test", "patern": "ball"}, "patern: Extra inputs"),
    ],
)
def test_refused_with_a_word(params: dict[str, Any], problem: str) -> None:
    assert problem in refusal(**params)


@pytest.mark.parametrize(
    ("fps", "expected"),
    [(30, "30/1"), (29.97, "30000/1001"), (23.976, "24000/1001"), (7.5, "15/2"), (12.4, "62/5")],
)
def test_rates_as_fractions(fps: float, expected: str) -> None:
    assert framerate(fps) == expected
