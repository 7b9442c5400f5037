"""What a fleet refuses, by name: clusters that are open to their network, and GPUs or their bytes
as resources of Ray. Imports Ray only inside a function.
"""

import ipaddress
from collections.abc import Iterable
from functools import wraps
from typing import Any, Final

from vram_arbiter.schemas.errors import BadRequest, NotPermitted
from vram_arbiter.schemas.plain import JsonMap

MARKER: Final = "vram_arbiter"
"""The only resource of ours that Ray counts: which nodes have an arbiter."""
CREATE: Final = "_remote"
"""What `remote` and `options` of Ray's class or task call, with all options by name."""


def refuse_open(addresses: Iterable[str], *, token: bool) -> None:
    """Raise NotPermitted for nodes that other machines reach without a token: Ray runs the code of
    everyone who connects."""
    for address in addresses:
        if not token and not ipaddress.ip_address(address).is_loopback:
            raise NotPermitted(
                f"this Ray cluster listens at {address} without authentication",
                hint="set RAY_AUTH_MODE=token and a token on all its nodes",
            )


def refuse_bytes(box: str, resources: Iterable[str]) -> None:
    """Raise BadRequest for a node that announces bytes of GPUs to Ray, which cannot evict."""
    for name in resources:
        said = name.casefold()
        if name != MARKER and ("vram" in said or ("gpu" in said and "mem" in said)):
            raise BadRequest(
                f"node {box} announces {name!r}: Ray would count bytes that its arbiter leases",
                hint=f"start it with the resource {MARKER!r} alone",
            )


def token_auth() -> bool:
    """Whether this process's Ray uses a token; only a private function of it says so."""
    from ray._private.authentication.authentication_utils import is_token_auth_enabled

    return bool(is_token_auth_enabled())


def refuse_options(options: JsonMap) -> None:
    """Raise BadRequest for GPUs or bytes among Ray's options of a leased actor or task."""
    asked = [name for name in ("num_gpus", "accelerator_type") if options.get(name)]
    for name in options.get("resources") or ():
        if name != MARKER and any(word in name.casefold() for word in ("gpu", "vram")):
            asked.append(name)
    if asked:
        raise BadRequest(
            f"resource {asked[0]!r} stands beside @leased: Ray would count what the arbiter leases",
            hint=f"leave it out; the only resource of a leased actor is {MARKER!r}",
        )


def guard(remote: Any) -> None:
    """Let Ray's class or task refuse options of `remote(…)` and `options(…).remote(…)`: Ray would
    wait for a node that has such GPUs, for ever."""
    create = getattr(remote, CREATE)

    @wraps(create)
    def guarded(*arguments: Any, **options: Any) -> Any:
        refuse_options(options)
        return create(*arguments, **options)

    setattr(remote, CREATE, guarded)
