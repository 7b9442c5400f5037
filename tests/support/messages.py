"""Messages of the arbiter as values, for tests that need any of a kind."""

from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.pushes import RevokePush
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply
from vram_arbiter.schemas.wire.views import HostRamView, LeaseView, Totals

NO_EVENTS = HistoryReply((), 0)
IDLE_STATUS = StatusReply(
    epoch=1,
    phase="serving",
    uptime_s=0.0,
    gpus=(),
    leases=(),
    totals=Totals(0, 0),
    clients=0,
    host_ram=HostRamView(0, 0),
    drained="",
    problems=(),
)


def no_reason(consumer: str) -> WhyReply:
    """The answer to `why` for a consumer without a lease."""
    return WhyReply(consumer, ())


def lease_view() -> LeaseView:
    """A lease of 1 GiB on GPU-1."""
    return LeaseView(
        lease_id="L1-1",
        token=Token(1, 2),
        state="loading",
        consumer="detector",
        model="m",
        gpu="GPU-1",
        mode="shared",
        priority=50,
        evictable=True,
        charge_bytes=1 << 30,
        uses=0,
        pid=7,
        since_s=0.0,
    )


def revoke(lease_id: str = "L1-1") -> RevokePush:
    """A revoke because of pressure."""
    return RevokePush(lease_id, Token(1, 2), "", 30.0, 0, park=False, cause="pressure")
