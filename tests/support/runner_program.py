"""`vram-runner` whose recorder forks its writers, and whose benchmark forks its workers."""

from tests.support import benchmark_workers, dataset_writer
from vram_arbiter.runner import __main__ as runner
from vram_arbiter.runner.benchmark import processes
from vram_arbiter.runner.recording import recorder

main = runner.main
vars(recorder)["subprocess"] = dataset_writer.FORKING
vars(processes)["subprocess"] = benchmark_workers.FORKING
