"""`vram-runner` whose recorder forks its writers (`dataset_writer`)."""

from tests.support.dataset_writer import FORKING
from vram_arbiter.runner import __main__ as runner
from vram_arbiter.runner.recording import recorder

main = runner.main
vars(recorder)["subprocess"] = FORKING
