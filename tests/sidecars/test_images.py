"""Pictures from strangers: what a decoder would have to do is known before it begins."""

import io
import struct
import time
import zlib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.sidecars import images

pytestmark = pytest.mark.heavy


def encoded(
    form: str, size: tuple[int, int] = (64, 48), mode: str = "RGB", **options: Any
) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.radial_gradient("L").resize(size).convert(mode).save(stream, form, **options)
    return stream.getvalue()


def png_chunk(kind: bytes, content: bytes = b"") -> bytes:
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def png(width: int, height: int, depth: int = 8, color: int = 2, *more: bytes) -> bytes:
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    pixels = png_chunk(b"IDAT", zlib.compress(bytes(100)))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(more) + pixels + png_chunk(b"IEND")


@pytest.mark.parametrize(
    ("form", "mode", "options"),
    [
        ("PNG", "RGB", {}), ("PNG", "L", {}), ("PNG", "P", {}), ("PNG", "RGBA", {}),
        ("PNG", "1", {}),
        ("JPEG", "RGB", {}), ("JPEG", "L", {}), ("JPEG", "RGB", {"progressive": True}),
        ("JPEG", "RGB", {"comment": b"\xff\xda" * 100}),
    ],
)  # fmt: skip
def test_what_cameras_and_programs_write_is_decoded(form: str, mode: str, options: Any) -> None:
    data = encoded(form, mode=mode, **options)
    found = images.header(data)
    assert (found.width, found.height) == (64, 48)
    assert found.scans <= images.SCANS_MAX
    picture = images.decode(data)
    assert (picture.mode, picture.size) == ("RGB", (64, 48))


def test_a_jpeg_of_thousands_of_scans_costs_nothing() -> None:
    """Regression: each scan is a pass over all pixels. 5,000 more of them, 33 bytes each, kept a
    sidecar busy for 55 s, with the lease in use."""
    data = encoded("JPEG", (2048, 2048), progressive=True)
    last = data[data.rindex(b"\xff\xda") : -2]
    began = time.process_time()
    with pytest.raises(BadRequest, match=r"501[0-9] scans; at most 12"):
        images.decode(data[:-2] + last * 5000 + data[-2:])
    assert time.process_time() - began < 5, "of the process, so that a busy machine does not count"


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (png(100_000, 1), "100000 x 1 pixels; a side has"),
        (png(0, 5), "0 x 5 pixels"),
        (png(16_000, 16_000), "more than 16777216 pixels"),
        (png(8, 8, 16, 0), "16 bits a sample"),
        (png(8, 8, 8, 7), "color type 7"),
        (png(8, 8, 8, 2, *[png_chunk(b"IDAT")] * 9_000), "more than 8192 chunks"),
        (b"\xff\xd8" + b"\xff\xe1\x00\x02" * 5_000, "more than 1000 segments"),
        (b"\xff\xd8" + b"\xff" * 100_000, "more than 1000 segments"),
        (b"\xff\xd8junk", "do not join"),
        (b"\xff\xd8\xff\xd0\xff\xd0", "segment 0xd0"),
        (b"\xff\xd8\xff\xc9\x00\x02", "segment 0xc9"),
        (b"GIF89a", "neither PNG nor JPEG"),
        (b"RIFF\x00\x00\x00\x00WEBP", "neither PNG nor JPEG"),
        (b"II*\x00", "neither PNG nor JPEG"),
        (b"", "neither PNG nor JPEG"),
        (png(4200, 4200, 1, 0), "4200 x 4200"),
        (png(64, 64)[:60], "cannot be decoded"),
    ],
)  # fmt: skip
def test_what_asks_for_too_much_is_refused_by_its_header(data: bytes, told: str) -> None:
    """Regression: Pillow clips 16-bit gray at 255, so such a PNG was seen as white."""
    with pytest.raises(BadRequest, match=told):
        images.decode(data)


def test_pictures_are_shrunk_never_enlarged() -> None:
    from PIL import Image

    for size, side, expected in (
        ((800, 600), 400, (400, 300)),
        ((3000, 1), 30, (30, 1)),
        ((80, 60), 400, (80, 60)),
    ):
        assert images.within(Image.new("RGB", size), side).size == expected


def test_a_frame_header_that_is_not_the_decoders_is_refused() -> None:
    """Two frames: one for the count, another for the decoder."""
    data = encoded("JPEG")
    at = data.index(b"\xff\xc0")
    frame = data[at : at + 2 + int.from_bytes(data[at + 2 : at + 4])]
    with pytest.raises(BadRequest, match="more than one frame"):
        images.decode(data[:at] + frame + data[at:])


@settings(max_examples=150, deadline=None)
@given(
    form=st.sampled_from(["PNG", "JPEG", "progressive"]),
    cuts=st.lists(st.tuples(st.integers(0, 3000), st.binary(max_size=6)), min_size=1, max_size=6),
    end=st.integers(0, 4000),
)
def test_damaged_pictures_are_decoded_or_refused(
    form: str, cuts: list[tuple[int, bytes]], end: int
) -> None:
    data = encoded("JPEG", progressive=True) if form == "progressive" else encoded(form)
    for at, inserted in cuts:
        at %= len(data)
        data = data[:at] + inserted + data[at + len(inserted) // 2 :]
    try:
        picture = images.decode(data[: max(end, 2)])
    except BadRequest:
        return
    assert picture.mode == "RGB"
    assert picture.width * picture.height <= images.PIXELS_MAX
