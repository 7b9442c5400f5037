"""What a server of the field is sent, and what its replies mean: the shapes without the transport.

Such a server has a REP socket, one model that is loaded before it listens, and no lease. It knows
`ping`, `detect`, `query`, `score` and `shutdown` of the op family, or `ping`, `get_action`,
`reset` and `kill` of the endpoint family. A request that it would answer about something else than
what was asked (without a token's fence, or one picture of several) is refused here.
"""

import io
import re
import struct
from typing import Any, Literal

from vram_arbiter.schemas.errors import BadRequest, ModelError, UnknownOp
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime import extras

Family = Literal["op", "endpoint"]

FIELDS = {
    "detect": {"image", "query", "max_side", "mode", "max_new_tokens"},
    "query": {"image", "question", "max_side", "max_new_tokens"},
    "score": {"images", "task", "num_bins"},
}
WITHOUT_EFFECT = {"score_threshold"}  # a grounding model gives no scores: each box counts as sure
SCORED_MAX = 8  # pictures of one `score`: the field's own client sends as many
SUCCESS_THRESHOLD = 0.5  # of the field's manifests, which its server does not read
ANSWER_MAX_CHARS = 65_536  # of a detector: 8,192 tokens
NORM = 1000

# The field's models repeat a box when they fail to end: copies, slivers and the whole picture.
SIDE_MIN = 0.02
AREA_MAX = 0.85

_GROUNDING = re.compile(
    r"<ref>([^<>]*)</ref>|<box><(\d{1,6})><(\d{1,6})><(\d{1,6})><(\d{1,6})></box>"
)
_PNG = struct.Struct(">8s4x4sII")  # signature, IHDR, width, height


def request(family: Family, op: str, fields: JsonMap) -> tuple[str, Message]:
    """Return the operation and the fields as a server of the field knows them.

    Raises: UnknownOp for what it has not; BadRequest for what it cannot be asked.
    """
    given = {key: value for key, value in fields.items() if value is not None and value != []}
    given.pop("traceparent", None)
    if family == "endpoint":
        return _policy_request(op, given)
    if op == "shutdown":
        return op, {}
    if op not in FIELDS:
        raise _unknown(op)
    if op == "query" and "image" not in given and len(given.get("images", [])) == 1:
        given["image"] = given.pop("images")[0]
    unsaid = sorted(given.keys() - FIELDS[op] - WITHOUT_EFFECT)
    if unsaid:
        raise BadRequest(
            f"another project's server cannot be asked for {op} with {', '.join(unsaid)}",
            hint="leave them out, or serve the model with vram-sidecar",
            details={"fields": unsaid},
        )
    sent = {key: value for key, value in given.items() if key in FIELDS[op]}
    if op == "query" and "image" not in sent:
        raise BadRequest("query needs an image", details={"fields": ["image"]})
    if op == "detect":
        _size_of(sent.get("image"))
        if isinstance(sent.get("query"), list):
            sent["query"] = "</c>".join(sent["query"])
    if op == "score":
        sent |= _raw(sent.pop("images", []))
    return op, sent


def result(op: str, fields: JsonMap, reply: Any) -> Any:
    """Return a reply with what ours has beside it. Raises ModelError for a wrong shape.

    `detect`: `detections` from the grounding text. `score`: `n`, the number of pictures that were
    sent, and the threshold of its manifest's default.
    """
    if op not in FIELDS:
        return reply
    if not isinstance(reply, dict):
        raise ModelError(f"{op} was answered with {type(reply).__name__}, expected a map")
    if op == "detect" and "detections" not in reply:
        size, query = _size_of(fields.get("image")), str(fields.get("query"))
        return reply | {"detections": grounded(reply.get("answer"), reply.get("norm"), size, query)}
    if op == "score":
        return {"success_threshold": SUCCESS_THRESHOLD, **reply, "n": fields.get("n")}
    return reply


def grounded(answer: object, norm: object, size: tuple[int, int], query: str) -> list[Message]:
    """Return the boxes of `<ref>label</ref><box><x1><y1><x2><y2></box>…` in pixels.

    A box has the label before it, else the query. Copies, slivers and boxes of nearly the whole
    picture are left out, as the field's client does. Raises ModelError.
    """
    if not isinstance(answer, str) or len(answer) > ANSWER_MAX_CHARS:
        raise ModelError(f"the detector's answer is not a text of {ANSWER_MAX_CHARS} letters")
    full = NORM if norm is None else norm
    if not isinstance(full, int) or full <= 0:
        raise ModelError(f"the detector's norm is {full!r}, not a number of steps")
    label, found = query, {}
    for ref, *corners in _GROUNDING.findall(answer):
        if not corners[0]:
            label = ref.strip() or query
            continue
        xa, ya, xb, yb = (min(1.0, int(corner) / full) for corner in corners)
        x0, x1, y0, y1 = min(xa, xb), max(xa, xb), min(ya, yb), max(ya, yb)
        if min(x1 - x0, y1 - y0) <= SIDE_MIN or (x1 - x0) * (y1 - y0) >= AREA_MAX:
            continue
        box = [x0 * size[0], y0 * size[1], x1 * size[0], y1 * size[1]]
        found[label, *box] = {"label": label, "score": 1.0, "box": box}
    return list(found.values())


def _policy_request(op: str, given: Message) -> tuple[str, Message]:
    data = given.get("data") or {}
    if "rtc" in given:
        raise BadRequest(
            "another project's server takes no remaining chunk",
            hint="leave rtc out of policy_extras, or serve the policy with vram-sidecar",
            details={"fields": ["rtc"]},
        )
    if op == "get_action":
        return op, {"data": {"options": None, **data}}
    if op == "reset":  # a server calls reset(**data), which knows `options`
        return op, {"data": data if data.keys() == {"options"} else {"options": data or None}}
    if op == "shutdown":
        return "kill", {}
    raise _unknown(op)


def _unknown(op: str) -> UnknownOp:
    return UnknownOp(
        f"another project's server has no {op}",
        hint="its model is loaded while it runs; start it with `vramctl run`, which holds its lease"
        if op in ("load", "unload")
        else "serve the model with vram-sidecar",
    )


def _size_of(image: object) -> tuple[int, int]:
    """Return width and height of a PNG. Raises BadRequest."""
    if isinstance(image, bytes) and len(image) >= _PNG.size:
        signature, header, width, height = _PNG.unpack_from(image)
        if (signature, header) == (b"\x89PNG\r\n\x1a\n", b"IHDR") and width and height:
            return width, height
    raise BadRequest("the image is not a PNG", hint="a grounding text has no pixels: send a PNG")


def _raw(images: list[bytes]) -> Message:
    """Return pictures as `score` takes them: raw BGR, one after another. Of more than `SCORED_MAX`
    as many are taken, evenly, the oldest and the newest among them. Raises BadRequest."""
    extras.need("another project's reward model", "PIL", extra="reasoner")
    from PIL import Image

    if not images:
        raise BadRequest("score needs pictures")
    last, steps = len(images) - 1, min(len(images), SCORED_MAX) - 1
    chosen = [images[round(step * last / steps)] for step in range(steps)] + [images[-1]]
    try:
        pictures = [Image.open(io.BytesIO(image)).convert("RGB") for image in chosen]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BadRequest(f"a picture cannot be decoded: {error}", hint="send PNGs") from None
    (width, height), *others = sizes = [picture.size for picture in pictures]
    if any(other != sizes[0] for other in others):
        raise BadRequest("the pictures are of several sizes", hint="send those of one camera")
    frames = b"".join(picture.tobytes("raw", "BGR") for picture in pictures)
    return {"frames": frames, "n": len(pictures), "width": width, "height": height}
