"""Names of spans, span events, metrics and attributes, and the units of metrics.

Those of the arbiter are in `clients.observer.names`, those of language models in
`reasoner.llm.names`.

Nothing is recorded here. Durations are in seconds and sizes in bytes; Prometheus appends
`_seconds`, `_bytes` and `_total` to the names. Labels are listed in docs/reference/metrics.md.

Recorded by: the observer `lease.*`, the runner `rskill.*` and the parts of a tick, the reasoner
`reasoner.*`, a sidecar `sidecar.*`, every command line `cli.command`. One trace runs through all of
them by the W3C `traceparent` on their sockets.
"""

from typing import NamedTuple

TRACER = "vram-arbiter"

# -- spans
SPAN_COMMAND = "cli.command"

SPAN_GOAL = "rskill.goal"
SPAN_ACTIVATE = "rskill.activate"
SPAN_TICK = "rskill.tick"
SPAN_SENSORS = "sensors.read"
SPAN_READ = "hal.read_state"
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

SPAN_GATEWAY_REQUEST = "gateway.request"

# -- events within a span
EVENT_DEADLINE_MISSED = "vram.event.deadline_missed"
EVENT_ESTOP = "vram.event.estop_requested"
EVENT_STALE = "vram.event.staleness_latched"
EVENT_ERROR = "vram.event.error_latched"
EVENT_SENSOR_STALE = "vram.event.sensor_stale"
EVENT_SAFETY_VIOLATION = "vram.event.safety_violation"
EVENT_ACTION_WITHHELD = "vram.event.action_withheld"
EVENT_ANSWER_REJECTED = "vram.event.answer_rejected"  # within reasoner.plan: asked again
EVENT_WOKEN = "vram.event.woken"  # within gateway.request: its server was away when it came
EVENT_GRANTED = "vram.event.granted"  # within gateway.request: its server can take it
EVENT_FIRST_BYTE = "vram.event.first_byte"
EVENT_PREFETCH_HIT = "vram.event.chunk_prefetch_hit"
EVENT_PREFETCH_MISS = "vram.event.chunk_prefetch_miss"

# -- metrics: name, unit and description, as a collector shows them, and bounds of a histogram;
# those of the arbiter are in `clients.observer.names`
CHATS_S = tuple(0.01 * 2**n for n in range(14))
"""Bounds that OpenTelemetry's conventions give for requests to language models, and for the time to
a first token."""
FIRST_TOKENS_S = (
    *(0.001, 0.005, 0.01, 0.02, 0.04, 0.06, 0.08),
    *(0.1, 0.25, 0.5, 0.75, 1.0, 2.5, 5.0, 7.5, 10.0),
)
WAITS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
TICKS_S = (
    *(0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.033, 0.04, 0.05),
    *(0.1, 0.25, 0.5, 1.0, 5.0),
)


class Instrument(NamedTuple):
    """`bounds`: upper bounds of a histogram's buckets; empty for other kinds."""

    unit: str
    description: str
    bounds: tuple[float, ...] = ()


INSTRUMENTS: dict[str, Instrument] = {}


def metric(name: str, unit: str, description: str, bounds: tuple[float, ...] = ()) -> str:
    """Describe a metric. Return its name."""
    INSTRUMENTS[name] = Instrument(unit, description, bounds)
    return name


METRIC_TICK = metric("vram_runner.tick.duration", "s", "One tick of the control loop", TICKS_S)
METRIC_INFERENCE = metric("vram_runner.inference.duration", "s", "One request to a skill", TICKS_S)
METRIC_CHUNK = metric("vram_runner.chunk.duration", "s", "A chunk's request to its answer", WAITS_S)
METRIC_PREFETCH = metric("vram_runner.chunk.prefetches", "{chunk}", "Chunks, in time or too late")
METRIC_STANDING = metric("vram_runner.chunk.standing_steps", "{step}", "Steps without an action")
METRIC_START_LATE = metric(
    "vram_runner.tick.start_delay", "s", "Late start of a goal's ticks", TICKS_S
)
METRIC_DEADLINE_MISSES = metric("vram_runner.tick.deadline_misses", "{tick}", "Ticks over too late")
METRIC_BUDGET_VIOLATIONS = metric(
    "vram_runner.tick.budget_violations", "{tick}", "Ticks longer than latency_budget_ms"
)
METRIC_HAL_READ = metric("vram_runner.hal.read.duration", "s", "One reading of the joints", TICKS_S)
METRIC_HAL_SEND = metric("vram_runner.hal.send.duration", "s", "One action to the motors", TICKS_S)
METRIC_SENSOR_AGE = metric("vram_runner.sensor.age", "s", "Age of what a tick reads", TICKS_S)
METRIC_STALE_READS = metric("vram_runner.sensor.stale_reads", "{read}", "Reads without fresh value")
METRIC_STALENESS = metric("vram_runner.world.staleness", "s", "Age within a world state", TICKS_S)
METRIC_COMPONENTS_STALE = metric(
    "vram_runner.world.components_stale", "{component}", "Components not to be trusted now"
)
METRIC_ESTOPS = metric("vram_runner.estops", "{stop}", "Emergency stops")
METRIC_SAFETY_VIOLATIONS = metric(
    "vram_runner.safety.violations", "{violation}", "Gate reports; error: the action was withheld"
)
METRIC_WITHHELD = metric("vram_runner.safety.withheld_actions", "{action}", "Actions not sent")
METRIC_LOOKS = metric("vram_runner.detector.looks", "{look}", "Looks of continuous detectors")
METRIC_STALE_DETECTIONS = metric(
    "vram_runner.detector.stale_answers", "{answer}", "Detections that became too old"
)
METRIC_GOALS = metric("vram_runner.goals", "{goal}", "Goals that ended")
METRIC_GPU_MEMORY = metric("vram_runner.gpu.memory.usage", "By", "GPU memory of this process")
METRIC_TOOL_CALLS = metric("vram_reasoner.tool_calls", "{call}", "Tool calls of the reasoner")
METRIC_SIDECAR_LOAD = metric("vram_sidecar.load.duration", "s", "One load onto the GPU", WAITS_S)
METRIC_SIDECAR_REQUEST = metric("vram_sidecar.request.duration", "s", "One request", TICKS_S)
METRIC_GATEWAY_WAIT = metric("vram_gateway.wait.duration", "s", "Wait for a server", WAITS_S)
METRIC_GATEWAY_WAITING = metric("vram_gateway.requests.waiting", "{request}", "Requests that wait")
METRIC_GATEWAY_IN_FLIGHT = metric(
    "vram_gateway.requests.in_flight", "{request}", "Requests at their servers"
)
METRIC_GATEWAY_REQUEST = metric(
    "gen_ai.server.request.duration", "s", "A request from its server's grant to its end", CHATS_S
)
METRIC_GATEWAY_FIRST_TOKEN = metric(
    "gen_ai.server.time_to_first_token", "s", "A server's grant to a token", FIRST_TOKENS_S
)
METRIC_CPU_TIME = metric("process.cpu.time", "s", "CPU time of this process")
METRIC_MEMORY = metric("process.memory.usage", "By", "RAM of this process")

# -- attributes and labels: a closed set, so that no metric's cardinality grows with use
ATTR_LEASE = "vram.lease_id"  # spans and log records only
ATTR_CONSUMER = "vram.consumer"
ATTR_MODEL = "vram.model"
ATTR_GPU = "vram.gpu"
ATTR_REASON = "vram.reason"
ATTR_BYTES = "vram.bytes"  # spans only
ATTR_SKILL = "rskill.id"
ATTR_REVISION = "rskill.revision"
ATTR_GOAL = "rskill.goal_id"  # spans only
ATTR_CONFIDENCE = "action.confidence"  # spans only
ATTR_TOOL = "reasoner.tool"
ATTR_SENSOR = "vram.sensor"
ATTR_OPERATION = "sidecar.operation"
ATTR_OUTCOME = "outcome"
ATTR_COMPONENT = "vram.component"  # of the world state: a sensor, joint_state, a detector
ATTR_CHECK = "safety.check_name"  # a `Check` of runner.safety.violations
ATTR_SEVERITY = "safety.severity"  # error: why an action is withheld; warning: all others
ATTR_CPU_MODE = "cpu.mode"
ATTR_ERROR_TYPE = "error.type"  # a code of schemas.errors, an exception's class, HTTP's status
ATTR_CHAT_OPERATION = "gen_ai.operation.name"
ATTR_PROVIDER = "gen_ai.provider.name"
ATTR_REQUEST_MODEL = "gen_ai.request.model"
ATTR_EXCEPTION_TYPE = "exception.type"  # of log records, as OpenTelemetry's conventions say
ATTR_EXCEPTION_MESSAGE = "exception.message"
ATTR_EXCEPTION_STACKTRACE = "exception.stacktrace"
ATTR_COMMAND = "cli.command"
ATTR_EXIT_CODE = "process.exit.code"  # spans only
