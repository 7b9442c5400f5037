"""`vram-runner` whose recorder forks its writers (`dataset_writer`)."""

from tests.support.dataset_writer import FORKING
from vram_arbiter.runner import __main__ as runner
from vram_arbiter.runner.recording import writer_process

main = runner.main
vars(writer_process)["subprocess"] = FORKING
