"""Names of all spans, span events, metrics and attributes, in one place. Names only: nothing is
recorded here.

Recorded by: the arbiter `lease.*`, the runner `rskill.*` and the parts of a tick, the reasoner
`reasoner.*`, a sidecar `sidecar.*`, every command line `cli.command`. One trace runs through all of
them by the W3C `traceparent` on their sockets.
"""

TRACER = "vram-arbiter"

# -- spans
SPAN_COMMAND = "cli.command"

SPAN_ACQUIRE = "lease.acquire"  # from the request to `ready`; children: what the time went into
SPAN_QUEUE = "lease.queue"
SPAN_EVICT = "lease.evict"  # one for each lease that had to leave
SPAN_VERIFY = "lease.verify"
SPAN_LOAD = "lease.load"

SPAN_GOAL = "rskill.goal"
SPAN_ACTIVATE = "rskill.activate"
SPAN_TICK = "rskill.tick"
SPAN_SENSORS = "sensors.read"
SPAN_WORLD = "world_state.snapshot"
SPAN_INFERENCE = "inference"
SPAN_CHUNK = "rskill.chunk_inference"
SPAN_SAFETY = "safety.check"
SPAN_SEND = "hal.send_action"
SPAN_EPISODE = "sim.episode"

SPAN_TASK = "reasoner.task"  # of a reasoner that serves tasks; otherwise cli.command is above
SPAN_REASONER_TICK = "reasoner.tick"
SPAN_PLAN = "reasoner.plan"
SPAN_TOOL = "reasoner.tool"

SPAN_SIDECAR_LOAD = "sidecar.load"
SPAN_SIDECAR_UNLOAD = "sidecar.unload"
SPAN_SIDECAR_REQUEST = "sidecar.request"

# -- events within a span
EVENT_DEADLINE_MISSED = "vram.event.deadline_missed"
EVENT_ESTOP = "vram.event.estop_requested"
EVENT_STALE = "vram.event.staleness_latched"
EVENT_ACTION_WITHHELD = "vram.event.action_withheld"
EVENT_REVOKE_ACKED = "vram.event.revoke_acked"  # within lease.evict
EVENT_REVOKE_WITHDRAWN = "vram.event.revoke_withdrawn"
EVENT_REMINDED = "vram.event.reminded"
EVENT_DEADLINE_PASSED = "vram.event.deadline_passed"
EVENT_SIGNALLED = "vram.event.signalled"
EVENT_UNLOADING = "vram.event.unloading"
EVENT_VERDICT = "vram.event.verdict"  # within lease.verify: one that allows no grant yet
EVENT_ANSWER_REJECTED = "vram.event.answer_rejected"  # within reasoner.plan: asked again
EVENT_DAEMON_STOPPED = "vram.event.daemon_stopped"  # the lease goes on, its span cannot
EVENT_PREFETCH_HIT = "vram.event.chunk_prefetch_hit"
EVENT_PREFETCH_MISS = "vram.event.chunk_prefetch_miss"

# -- metrics; units and descriptions are in `instruments`
METRIC_GRANTS = "vram_arbiter.lease.grants"
METRIC_DENIALS = "vram_arbiter.lease.denials"
METRIC_REFUSALS = "vram_arbiter.request.refusals"
METRIC_WAIT = "vram_arbiter.lease.wait.duration"
METRIC_WAITERS = "vram_arbiter.lease.waiters"
METRIC_OLDEST_WAIT = "vram_arbiter.lease.oldest_wait"
METRIC_EVICTIONS = "vram_arbiter.lease.evictions"
METRIC_VERDICTS = "vram_arbiter.lease.verdicts"
METRIC_LOSSES = "vram_arbiter.lease.losses"
METRIC_OOMS = "vram_arbiter.lease.ooms"
METRIC_HANDOVER = "vram_arbiter.handover.duration"
METRIC_CHARGED = "vram_arbiter.gpu.charged"
METRIC_MEASURED = "vram_arbiter.gpu.measured"  # the sum over consumers is METRIC_USED
METRIC_USED = "vram_arbiter.gpu.used"
METRIC_CAPACITY = "vram_arbiter.gpu.capacity"
METRIC_PRESSURE = "vram_arbiter.gpu.pressure"
METRIC_READABLE = "vram_arbiter.gpu.readable"
METRIC_READING_AGE = "vram_arbiter.gpu.reading_age"
METRIC_DRAINED = "vram_arbiter.drained"
METRIC_JOURNAL_HEALTHY = "vram_arbiter.journal.healthy"
METRIC_JOURNAL_DOUBTED = "vram_arbiter.journal.doubted"
METRIC_JOURNAL_WRITE = "vram_arbiter.journal.write.duration"
METRIC_JOURNAL_FAILURES = "vram_arbiter.journal.failures"
METRIC_CONFIG_REFUSED = "vram_arbiter.config.refused"
METRIC_BUILD = "vram_arbiter.build.info"
METRIC_TICK = "vram_runner.tick.duration"
METRIC_INFERENCE = "vram_runner.inference.duration"
METRIC_CHUNK = "vram_runner.chunk.duration"
METRIC_PREFETCH = "vram_runner.chunk.prefetches"
METRIC_STANDING = "vram_runner.chunk.standing_steps"
METRIC_START_LATE = "vram_runner.tick.start_delay"
METRIC_DEADLINE_MISSES = "vram_runner.tick.deadline_misses"
METRIC_HAL_READ = "vram_runner.hal.read.duration"
METRIC_HAL_SEND = "vram_runner.hal.send.duration"
METRIC_SENSOR_AGE = "vram_runner.sensor.age"
METRIC_STALE_READS = "vram_runner.sensor.stale_reads"
METRIC_WORLD_STALE = "vram_runner.world.stale_states"
METRIC_ESTOPS = "vram_runner.estops"
METRIC_SAFETY_VIOLATIONS = "vram_runner.safety.violations"
METRIC_WITHHELD = "vram_runner.safety.withheld_actions"
METRIC_LOOKS = "vram_runner.detector.looks"
METRIC_STALE_DETECTIONS = "vram_runner.detector.stale_answers"
METRIC_GOALS = "vram_runner.goals"
METRIC_GPU_MEMORY = "vram_runner.gpu.memory.usage"
METRIC_TOOL_CALLS = "vram_reasoner.tool_calls"
METRIC_SIDECAR_LOAD = "vram_sidecar.load.duration"
METRIC_SIDECAR_REQUEST = "vram_sidecar.request.duration"
# of every program, by OpenTelemetry's conventions
METRIC_CPU_TIME = "process.cpu.time"
METRIC_MEMORY = "process.memory.usage"

# -- attributes and labels: a closed set, so that no metric's cardinality grows with use
ATTR_LEASE = "vram.lease_id"  # spans and log records only
ATTR_CONSUMER = "vram.consumer"
ATTR_MODEL = "vram.model"
ATTR_GPU = "vram.gpu"
ATTR_VERDICT = "vram.verdict"
ATTR_REASON = "vram.reason"
ATTR_BYTES = "vram.bytes"  # spans only
ATTR_BYTES_BEFORE = "vram.bytes_before"  # spans only: the whole GPU when the unloading began
ATTR_BYTES_AFTER = "vram.bytes_after"  # spans only: and at the verdict
ATTR_WANTED_BY = "vram.wanted_by"  # spans only: the consumer that needs the room
ATTR_SKILL = "rskill.id"
ATTR_REVISION = "rskill.revision"
ATTR_GOAL = "rskill.goal_id"  # spans only
ATTR_TOOL = "reasoner.tool"
ATTR_SENSOR = "vram.sensor"
ATTR_OPERATION = "sidecar.operation"
ATTR_OUTCOME = "outcome"
ATTR_COMPONENT = "vram.component"  # of the world state: a sensor, joint_state, a detector
ATTR_CPU_MODE = "cpu.mode"
ATTR_ERROR_TYPE = "error.type"  # a code of schemas.errors, or an exception's class
ATTR_EXCEPTION_TYPE = "exception.type"  # of log records, as OpenTelemetry's conventions say
ATTR_EXCEPTION_MESSAGE = "exception.message"
ATTR_EXCEPTION_STACKTRACE = "exception.stacktrace"
ATTR_VERSION = "version"
ATTR_PYTHON = "python"
ATTR_COMMAND = "cli.command"
ATTR_EXIT_CODE = "process.exit.code"  # spans only

# -- OpenTelemetry's conventions for language models: one span `chat MODEL` a request
GEN_AI_TOKENS = "gen_ai.client.token.usage"
GEN_AI_DURATION = "gen_ai.client.operation.duration"
ATTR_CHAT_OPERATION = "gen_ai.operation.name"
ATTR_PROVIDER = "gen_ai.provider.name"
ATTR_REQUEST_MODEL = "gen_ai.request.model"
ATTR_REQUEST_MAX_TOKENS = "gen_ai.request.max_tokens"  # spans only, as all below but two
ATTR_RESPONSE_MODEL = "gen_ai.response.model"
ATTR_FINISH_REASONS = "gen_ai.response.finish_reasons"
ATTR_INPUT_TOKENS = "gen_ai.usage.input_tokens"
ATTR_OUTPUT_TOKENS = "gen_ai.usage.output_tokens"
ATTR_TOKEN_TYPE = "gen_ai.token.type"  # metrics only
ATTR_SERVER = "server.address"
ATTR_SERVER_PORT = "server.port"
