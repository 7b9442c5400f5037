"""Peak of a program's bytes, as the arbiter reads them."""

from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.replies import StatusReply


class Peak:
    """The most bytes that were seen of a program that asked for `asked_bytes`."""

    def __init__(self, asked_bytes: int) -> None:
        self._asked_bytes = asked_bytes
        self.seen_bytes = 0

    def measure(self, status: StatusReply, lease_id: str) -> None:
        used = sum(
            process.used_bytes or 0
            for gpu in status.gpus
            for process in gpu.processes
            if lease_id in process.lease_ids
        )
        self.seen_bytes = max(self.seen_bytes, used)

    def text(self) -> str:
        seen, asked = self.seen_bytes, self._asked_bytes
        if not seen:
            return "peak not measured: no reading showed bytes of the program"
        more = ", more than was asked for" if seen > asked else ""
        return f"peak {format_bytes(seen)} measured of {format_bytes(asked)} asked{more}"
