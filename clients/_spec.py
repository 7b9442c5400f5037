"""A lease spec from what a caller of `lease` or `acquire` writes."""

from collections.abc import Mapping
from dataclasses import fields as dataclass_fields

from pydantic import TypeAdapter, ValidationError

from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.sizes import parse_bytes, parse_need
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

_SPEC = TypeAdapter(LeaseSpec)

type Vram = int | str | Footprint
"""Bytes, a text such as `5.3GB` or `8GiB`, or a footprint with its parts."""


def checked_spec(fields: Mapping[str, object]) -> LeaseSpec:
    """Return the spec with these fields, within its limits. Raises pydantic's ValidationError."""
    return _SPEC.validate_python(fields)


def lease_spec(
    spec: LeaseSpec | None,
    name: str,
    vram: Vram | None,
    model: str | None,
    fields: Mapping[str, object],
) -> LeaseSpec:
    """Return `spec`, or one made of `vram`, `model` and other fields of LeaseSpec. The consumer is
    the client's `name` unless `fields` says otherwise.

    Raises: BadRequest for anything that is not a spec.
    """
    given = {"vram": vram, "model": model, **fields}
    if spec is not None:
        if clash := sorted(key for key, value in given.items() if value is not None):
            raise BadRequest(
                f"a spec was given together with {', '.join(clash)}",
                hint="give a LeaseSpec, or `vram` and `model`, not both",
            )
        return spec
    if vram is None:
        raise BadRequest(
            "neither a spec nor `vram` was given", hint="state the need, e.g. vram='5.3GB'"
        )
    own = {"consumer": name, "model_id": model or name, "footprint": _footprint(vram)}
    try:
        return checked_spec({**own, **fields})
    except ValidationError as error:
        wrong = error.errors()[0]
        where = ".".join(str(part) for part in wrong["loc"])
        known = ", ".join(field.name for field in dataclass_fields(LeaseSpec))
        raise BadRequest(
            f"{where}: {wrong['msg']}, got {wrong['input']!r}", hint=f"fields of a lease: {known}"
        ) from None


def _footprint(vram: Vram) -> Footprint:
    """One size is the peak of loading and the resident size too."""
    if isinstance(vram, Footprint):
        return vram
    try:
        size = parse_need(vram) if isinstance(vram, str) else parse_bytes(vram)
    except ValueError as error:
        raise BadRequest(str(error), hint="vram takes bytes or a text such as 5.3GB") from None
    return Footprint(
        load_peak_bytes=size, steady_bytes=size, residue_bytes=min(size, RESIDUE_BYTES)
    )
