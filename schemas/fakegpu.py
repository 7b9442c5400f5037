"""The simulated GPU: the format of its folder and every change that can happen to it, as pure
functions. No I/O, no clock.

One folder per GPU:
    gpu.json          what the GPU is, how it lags, which faults are on (`FakeGpuConfig`); may be
                      edited while it is in use
    PID-START.json    one file per process with bytes on the GPU (`ProcessFile`); any `*.json`
                      beside gpu.json counts, so a stowaway is a file with the pid of some living
                      process
    log.jsonl         append-only, one line per change (`LogLine`), for timelines and for the
                      independent checker
    lock              flock'ed exclusively around every reading and every change

Reader and writer do the I/O: take the lock, hand all texts to `read_gpu`, call transitions,
perform their `Edit`s in order. A step first replaces one process file (temporary file + rename),
then appends that file's `last` to the log. So a kill at any instant leaves a readable GPU, and at
most one line unwritten, which `read_gpu` orders the next process to append.

It behaves as a GPU under a caching framework does: a context on first touch stays until the
process ends; a freed block goes to the process's cache and only `empty_cache` gives it back; memory
comes back `release_lag_s` late, also that of a dead process; what does not fit raises
`SimulatedOutOfMemory` in the process that asked.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Literal, TypedDict

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import ConfigError, OutOfMemory
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.units import ByteSize, format_bytes
from vram_arbiter.schemas.wire.views import SensorsView

GPU_FILE = "gpu.json"
LOG_FILE = "log.jsonl"
LOCK_FILE = "lock"
FOLDER_VARIABLE = "VRAM_FAKE_GPU"
LOG_TAIL_BYTES = 8192  # of the log's end are enough to find its last line
RELEASE_LAG_S = 0.5  # the driver gives memory back 0.5-1.5 s after an exit

Lag = Annotated[float, Field(ge=0, le=3600)]
Alive = Callable[[ProcessKey], bool]


class SimulatedOutOfMemory(OutOfMemory):
    """The simulated GPU is full; stands for `torch.OutOfMemoryError`. details: requested_bytes,
    free_bytes, capacity_bytes."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Faults(_Frozen):
    """What goes wrong on purpose. `leak_bytes` of every process's emptied cache stay with it until
    it exits."""

    probe: Literal["ok", "fail", "hang"] = "ok"
    leak_bytes: ByteSize = 0
    hide_processes: bool = False  # the probe cannot list processes, as inside some containers


class FakeGpuConfig(_Frozen):
    """`gpu.json`. `throttle_bytes_per_s` is how fast a simulated load fills the GPU (None: at
    once)."""

    uuid: Annotated[str, Field(min_length=1, max_length=64)]
    name: Annotated[str, Field(max_length=NAME_MAX_CHARS)] = "Simulated GPU"
    index: Annotated[int, Field(ge=0)] = 0
    capacity_bytes: Annotated[ByteSize, Field(gt=0)]
    release_lag_s: Lag = RELEASE_LAG_S
    throttle_bytes_per_s: Annotated[ByteSize, Field(gt=0)] | None = None
    boot_id: str = ""  # of the machine's boot that the process files belong to
    sensors: SensorsView = SensorsView()
    faults: Faults = Faults()


class Returning(_Frozen):
    """Bytes that a process let go of and that are free again at `due_s` (monotonic)."""

    bytes: Annotated[int, Field(ge=0)]
    due_s: float


class LogLine(TypedDict):
    """One line of the log. `delta` is what it changed on the GPU; the sum of all deltas is
    `used_after`.

    ops: context, alloc, cache (freed into the process's cache), free (let go of: still on the
    GPU), leak, returned (free again), oom (refused: delta 0), died (noticed: delta 0), edited (pid
    0: process files were written or removed by hand).
    """

    seq: int
    t: float  # monotonic seconds
    pid: int
    start: int
    name: str
    op: str
    label: str
    bytes: int
    delta: int
    process_bytes: int  # this process's bytes on the GPU afterwards
    used_after: int
    capacity: int


class ProcessFile(_Frozen):
    """Bytes of one process. `start_ticks` 0: known by pid only."""

    pid: Annotated[int, Field(gt=0)]
    start_ticks: Annotated[int, Field(ge=0)] = 0
    name: Annotated[str, Field(max_length=NAME_MAX_CHARS)] = ""
    context_bytes: ByteSize = 0
    allocated_bytes: ByteSize = 0
    cached_bytes: ByteSize = 0
    leaked_bytes: ByteSize = 0
    returning: tuple[Returning, ...] = ()
    died_at_s: float | None = None  # when its death was first noticed
    last: JsonObject | None = None  # its newest LogLine

    @property
    def key(self) -> ProcessKey:
        return ProcessKey(self.pid, self.start_ticks)

    @property
    def own_bytes(self) -> int:
        """What a driver lists for the process."""
        return self.context_bytes + self.allocated_bytes + self.cached_bytes + self.leaked_bytes

    @property
    def on_gpu_bytes(self) -> int:
        """What the device total counts for it: also what is on its way back."""
        return self.own_bytes + sum(part.bytes for part in self.returning)


@dataclass(frozen=True, slots=True)
class Edit:
    """One atomic piece of I/O: replace (or, without `text`, remove) the file `name`, then append
    `line` to the log."""

    name: str
    text: str | None
    line: str = ""


@dataclass(frozen=True, slots=True)
class GpuState:
    """A GPU as of one reading. Transitions return the next one."""

    config: FakeGpuConfig
    processes: Mapping[str, ProcessFile]
    seq: int = 0
    logged_bytes: int = 0
    """Used bytes by the log; differ from `used_bytes` only after a file was edited by hand."""

    @property
    def used_bytes(self) -> int:
        return sum(process.on_gpu_bytes for process in self.processes.values())

    @property
    def free_bytes(self) -> int:
        return max(0, self.config.capacity_bytes - self.used_bytes)

    def process(self, key: ProcessKey) -> ProcessFile | None:
        return self.processes.get(file_name(key))


@dataclass(frozen=True, slots=True)
class Change:
    """What a transition did: the next GPU, the steps that make it so on disk, and the refusal, if
    it was one."""

    gpu: GpuState
    steps: tuple[Edit, ...] = ()
    error: SimulatedOutOfMemory | None = None

    def then(self, transition: Callable[[GpuState], "Change"]) -> "Change":
        """Chain another transition, unless this one was refused."""
        if self.error is not None:
            return self
        after = transition(self.gpu)
        return replace(after, steps=self.steps + after.steps)


def file_name(key: ProcessKey) -> str:
    """Name of the file that a process writes for itself."""
    return f"{key.pid}-{key.start_ticks}.json"


def is_process_file(name: str) -> bool:
    """Whether a file of the folder is a process's account (temporary files are not)."""
    return name.endswith(".json") and name != GPU_FILE


# -- texts
@lru_cache(maxsize=16)  # each reading reads it, and it is edited by hand
def parse_config(text: str | bytes) -> FakeGpuConfig:
    """Read `gpu.json`. Raises ConfigError."""
    return _parsed(FakeGpuConfig, GPU_FILE, text, "correct it")


def dump_config(config: FakeGpuConfig) -> str:
    """Text of `gpu.json`, made to be edited."""
    return config.model_dump_json(indent=2) + "\n"


def read_gpu(texts: Mapping[str, str], log_tail: str) -> Change:
    """A GPU from the texts of its files and the end of its log. The steps mend what a killed
    process left unfinished.

    Raises ConfigError for a file that is not what it should be.
    """
    if GPU_FILE not in texts:
        raise ConfigError(
            f"the folder of a simulated GPU has no {GPU_FILE}",
            hint="start the arbiter with --gpu fake:8GiB",
        )
    processes = {
        name: _parsed(ProcessFile, name, texts[name], "remove it if no process owns it")
        for name in sorted(filter(is_process_file, texts))
    }
    newest = _last_line(log_tail)
    logged = int(newest.get("seq", 0))
    lasts = [process.last for process in processes.values()]
    missing = [last for last in lasts if last is not None and int(last.get("seq", 0)) > logged]
    torn = bool(log_tail) and not log_tail.endswith("\n")
    steps: tuple[Edit, ...] = ()
    if torn or missing:
        missing.sort(key=lambda line: int(line["seq"]))
        lines = "".join(_dump(line) for line in missing)
        steps = (Edit("", None, ("\n" if torn else "") + lines),)
    newest = missing[-1] if missing else newest
    gpu = GpuState(
        parse_config(texts[GPU_FILE]),
        processes,
        int(newest.get("seq", 0)),
        int(newest.get("used_after", 0)),
    )
    return Change(gpu, steps)


def _last_line(log_tail: str) -> JsonMap:
    for text in reversed(log_tail.split("\n")[:-1]):  # what follows the last newline is torn
        try:
            line = json.loads(text)
        except ValueError:
            continue  # torn once, and ended since
        if isinstance(line, dict) and "seq" in line:
            return line
    return {}


def _dump(line: JsonMap) -> str:
    return json.dumps(line, separators=(",", ":")) + "\n"


def _parsed[M: BaseModel](model: type[M], name: str, text: str | bytes, hint: str) -> M:
    """Return the text of a file as its model. Raises ConfigError."""
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(part) for part in problem["loc"]) or "the text"
        raise ConfigError(
            f"{name} of a simulated GPU is wrong: {place}: {problem['msg']}", hint=hint
        ) from None


# -- transitions
_NOTHING: JsonObject = dict.fromkeys(
    ("context_bytes", "allocated_bytes", "cached_bytes", "leaked_bytes"), 0
)


def settle(gpu: GpuState, now: float, alive: Alive) -> Change:
    """Let time pass: notice edits by hand and deaths, and let what is due come back. Comes before
    every other transition."""
    change = _notice_edits(gpu, now)
    for name, process in gpu.processes.items():
        if process.died_at_s is None and not alive(process.key):
            process = process.model_copy(update={"died_at_s": now})
            change = change.then(_step(name, process, now, "died", process.on_gpu_bytes, 0))
        if process.died_at_s is not None and now >= process.died_at_s + gpu.config.release_lag_s:
            update = _NOTHING | {"returning": ()}
            change = change.then(_return(name, process, now, process.on_gpu_bytes, update))
            change = change.then(_remove(name))
            continue
        due = sum(part.bytes for part in process.returning if part.due_s <= now)
        if due:
            rest = tuple(part for part in process.returning if part.due_s > now)
            change = change.then(_return(name, process, now, due, {"returning": rest}))
    return change


def _notice_edits(gpu: GpuState, now: float) -> Change:
    delta = gpu.used_bytes - gpu.logged_bytes
    if not delta:
        return Change(gpu)
    line: LogLine = {
        "seq": gpu.seq + 1, "t": now, "pid": 0, "start": 0, "name": "edited by hand",
        "op": "edited", "label": "",
        "bytes": abs(delta), "delta": delta, "process_bytes": 0, "used_after": gpu.used_bytes,
        "capacity": gpu.config.capacity_bytes,
    }  # fmt: skip
    after = replace(gpu, seq=gpu.seq + 1, logged_bytes=gpu.used_bytes)
    return Change(after, (Edit("", None, _dump(line)),))


def touch(gpu: GpuState, key: ProcessKey, name: str, context_bytes: int, now: float) -> Change:
    """The first use of the GPU by a process puts its context there; later ones change nothing."""
    process = gpu.process(key) or ProcessFile(pid=key.pid, start_ticks=key.start_ticks, name=name)
    if process.context_bytes or not context_bytes:
        return Change(gpu)
    grown = process.model_copy(update={"context_bytes": context_bytes})
    return _grow(gpu, process, grown, now, "context", "context", context_bytes, context_bytes)


def allocate(
    gpu: GpuState, key: ProcessKey, name: str, label: str, size: int, now: float
) -> Change:
    """Put `size` bytes on the GPU for a process, from its own cache first. Refused with `error` if
    they do not fit."""
    process = gpu.process(key) or ProcessFile(pid=key.pid, start_ticks=key.start_ticks, name=name)
    cached = min(process.cached_bytes, size)
    grown = process.model_copy(
        update={
            "allocated_bytes": process.allocated_bytes + size,
            "cached_bytes": process.cached_bytes - cached,
        }
    )
    return _grow(gpu, process, grown, now, "alloc", label, size, size - cached)


def free(gpu: GpuState, key: ProcessKey, label: str, size: int, now: float) -> Change:
    """A block goes back to its process's cache; no other process gets it. Raises ValueError for
    more than is allocated."""
    process = gpu.process(key)
    if process is None or process.allocated_bytes < size:
        raise ValueError(f"process {key} frees {size} bytes that it has not")
    after = process.model_copy(
        update={
            "allocated_bytes": process.allocated_bytes - size,
            "cached_bytes": process.cached_bytes + size,
        }
    )
    return _step(file_name(key), after, now, "cache", size, 0, label)(gpu)


def empty_cache(gpu: GpuState, key: ProcessKey, now: float) -> Change:
    """A process gives its cache back to the GPU, where it is free `release_lag_s` later, less what
    leaks."""
    process = gpu.process(key)
    if process is None or not process.cached_bytes:
        return Change(gpu)
    leak = min(process.cached_bytes, max(0, gpu.config.faults.leak_bytes - process.leaked_bytes))
    freed = process.cached_bytes - leak
    change, name = Change(gpu), file_name(key)
    process = process.model_copy(
        update={"cached_bytes": freed, "leaked_bytes": process.leaked_bytes + leak}
    )
    if leak:
        change = change.then(_step(name, process, now, "leak", leak, 0))
    process = process.model_copy(
        update={"cached_bytes": 0, "returning": _later(process, freed, gpu, now)}
    )
    return change.then(_step(name, process, now, "free", freed, 0))


def leave(gpu: GpuState, key: ProcessKey, now: float) -> Change:
    """A process destroys its context and everything with it, as at an orderly exit."""
    process = gpu.process(key)
    if process is None or not process.own_bytes:
        return Change(gpu)
    freed = process.own_bytes
    update = _NOTHING | {"returning": _later(process, freed, gpu, now)}
    after = process.model_copy(update=update)
    return _step(file_name(key), after, now, "free", freed, 0)(gpu)


def _later(process: ProcessFile, size: int, gpu: GpuState, now: float) -> tuple[Returning, ...]:
    if not size:
        return process.returning
    return (*process.returning, Returning(bytes=size, due_s=now + gpu.config.release_lag_s))


def _grow(
    gpu: GpuState,
    before: ProcessFile,
    after: ProcessFile,
    now: float,
    op: str,
    label: str,
    size: int,
    delta: int,
) -> Change:
    name = file_name(before.key)
    if delta <= gpu.config.capacity_bytes - gpu.used_bytes:
        return _step(name, after, now, op, size, delta, label)(gpu)
    refused = _step(name, before, now, "oom", size, 0, label)(gpu)
    return replace(refused, error=_out_of_memory(gpu, before, size))


def _out_of_memory(gpu: GpuState, process: ProcessFile, size: int) -> SimulatedOutOfMemory:
    others = "".join(
        f" Process {other.pid} ({other.name or '?'}) has {format_bytes(other.on_gpu_bytes)} in use."
        for other in gpu.processes.values()
        if other.key != process.key and other.on_gpu_bytes
    )
    config = gpu.config
    return SimulatedOutOfMemory(
        f"CUDA out of memory (simulated). Tried to allocate {format_bytes(size)}. GPU "
        f"{config.index} has a total capacity of "
        f"{format_bytes(config.capacity_bytes)} of which {format_bytes(gpu.free_bytes)} is free. "
        f"This process has {format_bytes(process.own_bytes)} in use.{others}",
        details={
            "requested_bytes": size,
            "free_bytes": gpu.free_bytes,
            "capacity_bytes": config.capacity_bytes,
            "allocated_bytes": process.own_bytes,
        },
    )


def _step(
    name: str, process: ProcessFile, now: float, op: str, size: int, delta: int, label: str = ""
) -> Callable[[GpuState], Change]:
    def transition(gpu: GpuState) -> Change:
        line: LogLine = {
            "seq": gpu.seq + 1, "t": now, "pid": process.pid, "start": process.start_ticks,
            "name": process.name, "op": op,
            "label": label, "bytes": size, "delta": delta, "process_bytes": process.on_gpu_bytes,
            "used_after": gpu.logged_bytes + delta, "capacity": gpu.config.capacity_bytes,
        }  # fmt: skip
        written = process.model_copy(update={"last": dict(line)})
        after = GpuState(
            gpu.config, {**gpu.processes, name: written}, gpu.seq + 1, gpu.logged_bytes + delta
        )
        return Change(
            after, (Edit(name, written.model_dump_json(exclude_defaults=True), _dump(line)),)
        )

    return transition


def _return(
    name: str, process: ProcessFile, now: float, size: int, update: JsonMap
) -> Callable[[GpuState], Change]:
    return _step(name, process.model_copy(update=update), now, "returned", size, -size)


def _remove(name: str) -> Callable[[GpuState], Change]:
    def transition(gpu: GpuState) -> Change:
        processes = {other: process for other, process in gpu.processes.items() if other != name}
        return Change(replace(gpu, processes=processes), (Edit(name, None),))

    return transition


# -- making one
def new_gpu(wanted: FakeGpuConfig, existing: str | None, *, in_use: bool) -> FakeGpuConfig | None:
    """Return the GPU with which a folder begins anew, without process files and log; None keeps the
    one that is there: a restarted daemon must find what living processes still hold.

    Process files of an earlier boot are void. Raises ConfigError if the GPU is in use with another
    capacity.
    """
    if existing is None:
        return wanted
    current = parse_config(existing)
    if current.boot_id == wanted.boot_id:
        if current.capacity_bytes == wanted.capacity_bytes:
            return None
        if in_use:
            raise ConfigError(
                f"a simulated GPU of {format_bytes(current.capacity_bytes)} is in use here, not "
                f"one of {format_bytes(wanted.capacity_bytes)}",
                hint="stop the processes that use it, or choose another runtime folder",
            )
    return wanted.model_copy(update={"uuid": current.uuid})
