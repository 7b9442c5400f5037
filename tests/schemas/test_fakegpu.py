"""The simulated GPU as pure transitions: never over capacity, nothing lost, and a kill at any
instant leaves it readable."""

import json

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from tests.support.fakegpu_check import check_log
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.errors import CODES, ConfigError, OutOfMemory
from vram_arbiter.schemas.ids import ProcessKey

GB = 10**9
CONFIG = fakegpu.FakeGpuConfig(
    uuid="GPU-fake-1", capacity_bytes=8 * GB, release_lag_s=0.5, boot_id="boot"
)
A, B = ProcessKey(100, 1), ProcessKey(200, 2)


class Folder:
    """A GPU's folder in memory; can be killed in the middle of a step."""

    def __init__(self, config: fakegpu.FakeGpuConfig = CONFIG) -> None:
        self.texts = {fakegpu.GPU_FILE: fakegpu.dump_config(config)}
        self.log = ""
        self.now = 0.0
        self.dead: set[ProcessKey] = set()

    def do(self, transition, *args, kill_at: int | None = None):
        """Apply a transition as reader and writer do. `kill_at` n: only the first n pieces of I/O
        happen, the last log line torn."""
        change = (
            fakegpu.read_gpu(self.texts, self.log[-fakegpu.LOG_TAIL_BYTES :])
            .then(lambda gpu: fakegpu.settle(gpu, self.now, lambda key: key not in self.dead))
            .then(lambda gpu: transition(gpu, *args, self.now))
        )
        pieces = 0
        for step in change.steps:
            for what in ("file", "line"):
                if kill_at is not None and pieces == kill_at:
                    if what == "line":
                        self.log += step.line[: len(step.line) // 2]
                    return change
                pieces += 1
                if what == "line":
                    self.log += step.line
                elif step.text is not None:
                    self.texts[step.name] = step.text
                elif step.name:
                    del self.texts[step.name]
        return change

    @property
    def gpu(self) -> fakegpu.GpuState:
        return self.do(lambda gpu, now: fakegpu.Change(gpu)).gpu


def allocate(folder: Folder, key: ProcessKey, size: int):
    return folder.do(fakegpu.allocate, key, "p", "weights", size)


def test_what_fits_is_allocated_and_what_does_not_is_refused_with_the_numbers():
    folder = Folder()
    assert allocate(folder, A, 5 * GB).error is None
    error = allocate(folder, B, 4 * GB).error
    assert isinstance(error, OutOfMemory)
    assert error.details == {
        "requested_bytes": 4 * GB, "free_bytes": 3 * GB, "capacity_bytes": 8 * GB,
        "allocated_bytes": 0
    }  # fmt: skip
    assert error.message.startswith(
        "CUDA out of memory (simulated). Tried to allocate 3.73 GiB. GPU 0 has a total capacity"
    )
    assert "Process 100 (p) has 4.66 GiB in use" in error.message
    assert folder.gpu.used_bytes == 5 * GB
    assert CODES["oom"] is OutOfMemory, "the wire code names the public type"


def test_the_context_is_charged_once_and_stays():
    folder = Folder()
    for _ in range(2):
        folder.do(fakegpu.touch, A, "p", GB)
    assert folder.gpu.used_bytes == GB
    allocate(folder, A, GB)
    folder.do(fakegpu.free, A, "weights", GB)
    folder.do(fakegpu.empty_cache, A)
    folder.now = 10
    assert folder.gpu.used_bytes == GB


def test_a_freed_block_stays_in_the_cache_until_it_is_emptied_and_then_comes_back_late():
    folder = Folder()
    allocate(folder, A, 5 * GB)
    folder.do(fakegpu.free, A, "weights", 5 * GB)
    assert allocate(folder, B, 4 * GB).error is not None, (
        "the cache belongs to the process that freed"
    )
    assert allocate(folder, A, 6 * GB).error is None, "which gets it without asking the GPU again"
    folder.do(fakegpu.free, A, "weights", 6 * GB)
    folder.do(fakegpu.empty_cache, A)
    folder.now = 0.4
    assert allocate(folder, B, 4 * GB).error is not None
    process = folder.gpu.process(A)
    assert (process.own_bytes, process.on_gpu_bytes) == (0, 6 * GB), (
        "gone from the process, not from the GPU"
    )
    folder.now = 0.5
    assert allocate(folder, B, 4 * GB).error is None


def test_memory_of_a_dead_process_comes_back_after_the_lag_counted_from_the_first_notice():
    folder = Folder()
    folder.do(fakegpu.touch, A, "p", GB)
    allocate(folder, A, 5 * GB)
    folder.dead.add(A)
    folder.now = 100.0
    assert folder.gpu.used_bytes == 6 * GB
    folder.now = 100.4
    assert folder.gpu.used_bytes == 6 * GB
    folder.now = 100.5
    assert folder.gpu.used_bytes == 0
    assert folder.gpu.processes == {}
    assert [json.loads(line)["op"] for line in folder.log.splitlines()][-2:] == ["died", "returned"]


def test_a_leak_keeps_bytes_until_the_process_exits():
    folder = Folder(CONFIG.model_copy(update={"faults": fakegpu.Faults(leak_bytes=GB)}))
    for _ in range(2):
        allocate(folder, A, 3 * GB)
        folder.do(fakegpu.free, A, "weights", 3 * GB)
        folder.do(fakegpu.empty_cache, A)
        folder.now += 1
        assert folder.gpu.used_bytes == GB, "it leaks once, not at every unload"
    folder.dead.add(A)
    assert folder.gpu.used_bytes == GB
    folder.now += 1
    assert folder.gpu.used_bytes == 0


def test_freeing_what_was_never_allocated_is_a_mistake_of_the_program():
    with pytest.raises(ValueError, match="frees 5 bytes that it has not"):
        Folder().do(fakegpu.free, A, "weights", 5)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("gpu.json", "{", "gpu.json"),
        ("gpu.json", '{"uuid": "x", "capacity_bytes": "8GiB", "colour": 1}', "colour"),
        ("100-1.json", '{"pid": -1}', "100-1.json"),
    ],
)
def test_a_file_that_is_wrong_is_named(name, text, told):
    folder = Folder()
    folder.texts[name] = text
    with pytest.raises(ConfigError, match=told):
        folder.gpu  # noqa: B018


def test_a_stowaway_is_a_file_that_anybody_may_write():
    folder = Folder()
    folder.texts["browser.json"] = '{"pid": 1, "name": "browser", "allocated_bytes": "2GB"}'
    assert folder.gpu.used_bytes == 2 * GB
    allocate(folder, A, GB)
    assert check_log(folder.log).problems == []
    assert check_log(folder.log).peak_bytes == 3 * GB
    folder.dead.add(ProcessKey(1, 0))
    folder.now = 1
    folder.gpu  # noqa: B018  its death is noticed
    folder.now = 2
    assert "browser.json" not in folder.gpu.processes
    folder.texts["browser.json"] = '{"pid": 1, "name": "browser", "allocated_bytes": "2GB"}'
    del folder.texts["100-1.json"]
    folder.dead.clear()
    assert folder.gpu.used_bytes == 2 * GB
    assert check_log(folder.log).problems == [], "files that come and go by hand are on the record"


def test_a_gpu_survives_the_daemon_but_not_the_boot():
    existing = fakegpu.dump_config(CONFIG)
    same = CONFIG.model_copy(update={"uuid": "other"})
    assert fakegpu.new_gpu(same, existing, in_use=True) is None
    rebooted = same.model_copy(update={"boot_id": "next"})
    made = fakegpu.new_gpu(rebooted, existing, in_use=True)
    assert (made.boot_id, made.uuid) == ("next", CONFIG.uuid), "a GPU keeps its name"
    larger = CONFIG.model_copy(update={"capacity_bytes": 16 * GB})
    with pytest.raises(ConfigError, match="is in use here"):
        fakegpu.new_gpu(larger, existing, in_use=True)
    assert fakegpu.new_gpu(larger, existing, in_use=False) == larger
    assert fakegpu.new_gpu(larger, None, in_use=True) == larger


@pytest.mark.parametrize("kill_at", range(8))
def test_a_kill_at_any_instant_leaves_a_gpu_whose_log_still_adds_up(kill_at):
    folder = Folder()
    allocate(folder, A, 2 * GB)
    folder.now = 1.0

    def two_steps(gpu, now):
        return fakegpu.touch(gpu, B, "p", GB, now).then(
            lambda after: fakegpu.allocate(after, B, "p", "weights", 3 * GB, now)
        )

    folder.do(two_steps, kill_at=kill_at)
    folder.dead.add(B)
    for folder.now in (2.0, 3.0, 4.0):
        allocate(folder, A, GB)
    report = check_log(folder.log)
    assert report.problems == []
    assert folder.gpu.used_bytes == 5 * GB


def test_the_checker_finds_what_is_wrong():
    folder = Folder()
    allocate(folder, A, 2 * GB)
    allocate(folder, B, 2 * GB)
    lines = [json.loads(line) for line in folder.log.splitlines()]

    def problems(**wrong):
        return check_log(
            "".join(json.dumps(line) + "\n" for line in [lines[0], lines[1] | wrong])
        ).problems

    assert problems() == []
    for wrong in (
        {"capacity": GB}, {"used_after": 1}, {"seq": 3}, {"t": -1.0}, {"process_bytes": 1},
        {"op": "steal"},
        {"op": "oom"}, {"op": "returned"},
    ):  # fmt: skip
        assert problems(**wrong), wrong
    assert check_log("{torn").torn_lines == 1
    assert check_log("{torn\n[]\n").torn_lines == 2


class GpuMachine(RuleBasedStateMachine):
    """Any order of changes by three processes, kills in the middle of a write included."""

    keys = st.sampled_from([ProcessKey(n, n) for n in (1, 2, 3)])
    kills = st.one_of(st.none(), st.none(), st.integers(0, 6))

    def __init__(self) -> None:
        super().__init__()
        faults = fakegpu.Faults(leak_bytes=7)
        self.folder = Folder(CONFIG.model_copy(update={"capacity_bytes": 1000, "faults": faults}))

    def _do(self, key, kill_at, transition, *args) -> None:
        if key not in self.folder.dead:
            self.folder.do(transition, *args, kill_at=kill_at)
            if kill_at is not None:
                self.folder.dead.add(key)

    @rule(key=keys, size=st.integers(1, 900), kill_at=kills)
    def allocate(self, key, size, kill_at):
        def change(gpu, now):
            touched = fakegpu.touch(gpu, key, "p", 50, now)
            return touched.then(lambda after: fakegpu.allocate(after, key, "p", "w", size, now))

        self._do(key, kill_at, change)

    @rule(key=keys, share=st.floats(0, 1), kill_at=kills)
    def free(self, key, share, kill_at):
        process = self.folder.gpu.process(key)
        if process is not None:
            self._do(key, kill_at, fakegpu.free, key, "w", int(process.allocated_bytes * share))

    @rule(key=keys, kill_at=kills)
    def empty_cache(self, key, kill_at):
        self._do(key, kill_at, fakegpu.empty_cache, key)

    @rule(key=keys, kill_at=kills)
    def leave(self, key, kill_at):
        self._do(key, kill_at, fakegpu.leave, key)

    @rule(key=keys)
    def die(self, key):
        self.folder.dead.add(key)

    @rule(seconds=st.floats(0, 2))
    def time_passes(self, seconds):
        self.folder.now += seconds

    @invariant()
    def never_over_capacity(self):
        gpu = self.folder.gpu
        assert 0 <= gpu.used_bytes <= gpu.config.capacity_bytes

    def teardown(self):
        self.folder.dead.update(ProcessKey(n, n) for n in (1, 2, 3))
        for _ in range(2):
            self.folder.gpu  # noqa: B018  deaths are noticed, then everything is due
            self.folder.now += 10
        assert self.folder.gpu.used_bytes == 0
        assert check_log(self.folder.log).problems == []


TestGpuMachine = GpuMachine.TestCase
TestGpuMachine.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
