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
EVENT_REMINDED = "vram.event.reminded"
EVENT_DEADLINE_PASSED = "vram.event.deadline_passed"
EVENT_SIGNALLED = "vram.event.signalled"
EVENT_UNLOADING = "vram.event.unloading"
EVENT_VERDICT = "vram.event.verdict"  # within lease.verify: one that allows no grant yet
EVENT_ANSWER_REJECTED = "vram.event.answer_rejected"  # within reasoner.plan: asked again
EVENT_DAEMON_STOPPED = "vram.event.daemon_stopped"  # the lease goes on, its span cannot
EVENT_PREFETCH_HIT = "vram.event.chunk_prefetch_hit"
EVENT_PREFETCH_MISS = "vram.event.chunk_prefetch_miss"

# -- metrics: name, unit in the name's comment; labels are ATTR_ names
METRIC_GRANTS = "vram.lease.grants"  # 1, by consumer
METRIC_DENIALS = "vram.lease.denials"  # 1, by reason
METRIC_WAIT = "vram.lease.wait"  # s, from request to grant
METRIC_WAITERS = "vram.lease.waiters"  # 1, now
METRIC_EVICTIONS = "vram.evictions"  # 1, by verdict
METRIC_HANDOVER = "vram.handover"  # s, from the first ask to the grant that needed the room
METRIC_CHARGED = "vram.gpu.charged"  # By, by GPU and consumer
METRIC_MEASURED = (
    "vram.gpu.measured"  # By, by GPU and consumer; the sum over consumers is METRIC_USED
)
METRIC_USED = "vram.gpu.used"  # By, by GPU
METRIC_CAPACITY = "vram.gpu.capacity"  # By, by GPU
METRIC_PRESSURE = "vram.gpu.pressure"  # By, by GPU: held beyond what was granted
METRIC_READING_AGE = "vram.gpu.reading_age"  # s, by GPU: since the newest successful reading
METRIC_DRAINED = "vram.drained"  # 1 while an operator's drain stops grants, else 0
METRIC_JOURNAL_HEALTHY = "vram.journal.healthy"  # 1, or 0 while the journal cannot be written
METRIC_JOURNAL_WRITE = "vram.journal.write"  # s, one transaction
METRIC_JOURNAL_FAILURES = "vram.journal.failures"  # 1, transactions that failed
METRIC_BUILD = "vram.build.info"  # always 1, by version and Python's version
METRIC_TICK = "vram.tick.duration"  # s
METRIC_INFERENCE = "vram.inference.duration"  # s
METRIC_CHUNK = "vram.chunk.latency"  # s, by skill: from a chunk's request to its answer
METRIC_PREFETCH = "vram.chunk.prefetch"  # 1, by skill and outcome: hit or miss
METRIC_STANDING = "vram.chunk.standing_steps"  # 1, by skill: steps without an action to play
METRIC_START_LATE = "vram.tick.start_delay"  # s, by skill: from a goal's first action on
METRIC_DEADLINE_MISSES = "vram.tick.deadline_misses"  # 1: violations of the tick's time budget
METRIC_HAL_READ = "vram.hal.read.duration"  # s: the robot's joint state
METRIC_HAL_SEND = "vram.hal.send.duration"  # s: an action to the motors
METRIC_SENSOR_AGE = "vram.sensor.age"  # s, by sensor: of what a tick read
METRIC_STALE_READS = "vram.sensor.stale_reads"  # 1, by sensor: reads without a fresh value
METRIC_WORLD_STALE = "vram.world.stale"  # 1, by component: world states in which it was stale
METRIC_ESTOPS = "vram.estops"  # 1
METRIC_SAFETY_VIOLATIONS = "vram.safety.violations"  # 1
METRIC_WITHHELD = "vram.safety.withheld"  # 1
METRIC_LOOKS = "vram.detector.looks"  # 1, by sensor and type of error: of continuous detectors
METRIC_STALE_DETECTIONS = "vram.detector.stale"  # 1, by sensor: answers that were too old
METRIC_GOALS = "vram.goals"  # 1, by skill and state
METRIC_TOOL_CALLS = "vram.reasoner.tool_calls"  # 1, by tool and outcome
METRIC_SIDECAR_LOAD = "vram.sidecar.load"  # s, by model
METRIC_SIDECAR_REQUEST = "vram.sidecar.request"  # s, by operation and outcome
# of every program; the first two have the names of OpenTelemetry's conventions
METRIC_CPU_TIME = "process.cpu.time"  # s, by mode
METRIC_MEMORY = "process.memory.usage"  # By
METRIC_GPU_MEMORY = "vram.process.gpu_memory"  # By, by GPU: what this process holds there

# -- attributes and labels: a closed set, so that no metric's cardinality grows with use
ATTR_LEASE = "vram.lease_id"  # spans only
ATTR_CONSUMER = "vram.consumer"
ATTR_MODEL = "vram.model"
ATTR_GPU = "vram.gpu"
ATTR_VERDICT = "vram.verdict"
ATTR_REASON = "vram.reason"
ATTR_BYTES = "vram.bytes"  # spans only
ATTR_BYTES_BEFORE = "vram.bytes_before"  # spans only: the whole card when the unloading began
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
GEN_AI_TOKENS = "gen_ai.client.token.usage"  # {token}, by model and type
GEN_AI_DURATION = "gen_ai.client.operation.duration"  # s, by model and error
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
