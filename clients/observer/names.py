"""Names of the arbiter's spans and metrics, which nothing but the observer records."""

from vram_arbiter.schemas.runtime.telemetry.names import WAITS_S, metric

# -- spans, their events and attributes
SPAN_ACQUIRE = "lease.acquire"  # from the request to `ready`; children: what the time went into
SPAN_QUEUE = "lease.queue"
SPAN_EVICT = "lease.evict"  # one for each lease that had to leave
SPAN_VERIFY = "lease.verify"
SPAN_LOAD = "lease.load"
EVENT_REVOKE_ACKED = "vram.event.revoke_acked"  # within lease.evict
EVENT_REVOKE_WITHDRAWN = "vram.event.revoke_withdrawn"
EVENT_REMINDED = "vram.event.reminded"
EVENT_DEADLINE_PASSED = "vram.event.deadline_passed"
EVENT_SIGNALLED = "vram.event.signalled"
EVENT_UNLOADING = "vram.event.unloading"
EVENT_VERDICT = "vram.event.verdict"  # within lease.verify: one that allows no grant yet
EVENT_DAEMON_STOPPED = "vram.event.daemon_stopped"  # the lease goes on, its span cannot
ATTR_VERDICT = "vram.verdict"
ATTR_BYTES_BEFORE = "vram.bytes_before"  # spans only: the whole GPU when the unloading began
ATTR_BYTES_AFTER = "vram.bytes_after"  # spans only: and at the verdict
ATTR_WANTED_BY = "vram.wanted_by"  # spans only: the consumer that needs the room
ATTR_HARDWARE, HARDWARE_GPU = "hw.type", "gpu"  # of OpenTelemetry's `hw.*`, as is the next
ATTR_HARDWARE_ID = "hw.id"  # the GPU's
ATTR_VERSION = "version"
ATTR_PYTHON = "python"

# -- metrics
METRIC_GRANTS = metric("vram_arbiter.lease.grants", "{lease}", "Leases granted")
METRIC_DENIALS = metric(
    "vram_arbiter.lease.denials", "{request}", "Requests for a lease that ended without one"
)
METRIC_REFUSALS = metric(
    "vram_arbiter.request.refusals", "{request}", "Requests of any kind that were refused"
)
METRIC_WAIT = metric(
    "vram_arbiter.lease.wait.duration", "s", "From the request to the grant", WAITS_S
)
METRIC_WAITERS = metric("vram_arbiter.lease.waiters", "{request}", "Requests that wait")
METRIC_OLDEST_WAIT = metric(
    "vram_arbiter.lease.oldest_wait", "s", "How long the oldest request has waited; 0: none"
)
METRIC_EVICTIONS = metric("vram_arbiter.lease.evictions", "{lease}", "Evictions with a verdict")
METRIC_VERDICTS = metric(
    "vram_arbiter.lease.verdicts",
    "{verdict}",
    "Verdicts on released memory; an unresolved one is followed by another",
)
METRIC_LOSSES = metric(
    "vram_arbiter.lease.losses", "{lease}", "Leases that ended without a release"
)
METRIC_OOMS = metric(
    "vram_arbiter.lease.ooms", "{report}", "Failed allocations that holders reported"
)
METRIC_HANDOVER = metric(
    "vram_arbiter.handover.duration",
    "s",
    "From the first revoke to the grant that needed the room",
    WAITS_S,
)
METRIC_CHARGED = metric("vram_arbiter.gpu.charged", "By", "Bytes on the ledger")
METRIC_MEASURED = metric("vram_arbiter.gpu.measured", "By", "Bytes held by a consumer's processes")
METRIC_USED = metric("vram_arbiter.gpu.used", "By", "Bytes held on the GPU")
METRIC_CAPACITY = metric("vram_arbiter.gpu.capacity", "By", "Bytes of the GPU")
METRIC_PRESSURE = metric(
    "vram_arbiter.gpu.pressure", "By", "Bytes held beyond the budget; normally 0"
)
METRIC_READABLE = metric(
    "vram_arbiter.gpu.readable", "", "1 while readings succeed, else 0: nothing is granted"
)
METRIC_READING_AGE = metric(
    "vram_arbiter.gpu.reading_age",
    "s",
    "Since the newest successful reading; an idle arbiter reads rarely",
)
METRIC_UTILIZATION = metric(
    "hw.gpu.utilization", "1", "Share of the last moments in which the GPU was busy"
)
METRIC_TEMPERATURE = metric("hw.temperature", "Cel", "Temperature of the GPU")
METRIC_POWER = metric("hw.power", "W", "Power of the GPU's board")
METRIC_DRAINED = metric(
    "vram_arbiter.drained", "", "1 while an operator's drain stops grants, else 0"
)
METRIC_JOURNAL_HEALTHY = metric(
    "vram_arbiter.journal.healthy", "", "1 while the journal can be written, else 0"
)
METRIC_JOURNAL_DOUBTED = metric(
    "vram_arbiter.journal.doubted",
    "",
    "1 while the journal may not name every lease, which stops grants; else 0",
)
METRIC_JOURNAL_WRITES = metric(
    "vram_arbiter.journal.writes", "{write}", "Transactions of the journal"
)
METRIC_JOURNAL_TIME = metric("vram_arbiter.journal.write.time", "s", "Time of all transactions")
METRIC_JOURNAL_FAILURES = metric(
    "vram_arbiter.journal.failures", "{failure}", "Transactions that failed"
)
METRIC_CONFIG_REFUSED = metric(
    "vram_arbiter.config.refused",
    "",
    "1 while a changed configuration is refused and the former one is in force, else 0",
)
METRIC_BUILD = metric("vram_arbiter.build.info", "", "Always 1; the version of the daemon")
