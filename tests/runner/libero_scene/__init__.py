"""A suite of LIBERO with one scene of our own, for `--env.discover_packages_path`."""

from pathlib import Path

from libero.libero.benchmark import Benchmark, Task, register_benchmark

SCENE = Path(__file__).with_name("cheese_on_plate.bddl")
"""LIBERO joins it to its folder of scenes, which an absolute path replaces."""


class own_scene(Benchmark):  # type: ignore[misc]  # the name of the suite is the name of its class
    """One task; its objects stand where the scene says, without a file of first states."""

    def __init__(self, task_order_index: int = 0) -> None:
        super().__init__(task_order_index)
        self.name = "own_scene"
        task = "put the cream cheese on the plate"
        self.tasks = [Task(SCENE.stem, task, "Libero", "", str(SCENE), "")]
        self.n_tasks = 1


register_benchmark(own_scene)
