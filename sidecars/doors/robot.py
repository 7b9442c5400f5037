"""One robot at lerobot's door: its instructions, its queue of one observation, its history.

Which observations are looked at is decided as lerobot's server decides it (`policy_server.py`,
`_enqueue_observation`), with two differences. A newer observation always takes the place of one
that still waits. After a failure the next one is looked at: the robot, which waits for actions,
marks no other as `must_go`. Must not know gRPC or pickles.
"""

import asyncio
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.sidecars.doors.lerobot_messages import STATE, TASK, Instructions, Observation
from vram_arbiter.sidecars.doors.offers import FRESH_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIMILAR: Final = 1.0
"""Distance of two states, in the robot's units, below which lerobot takes them for the same."""
PREDICTED_MAX: Final = 1000  # time steps that are remembered
HISTORY_MAX: Final = 16  # control steps


class Robot:
    """One robot. `turn` serializes its requests for actions, `receiving` its observations."""

    def __init__(self, asked: Instructions, sidecar: PolicyClient) -> None:
        self.asked = asked
        self.turn, self.receiving = asyncio.Lock(), asyncio.Lock()
        self._sidecar = sidecar
        self._waiting: tuple[Observation, float] | None = None  # and when it came
        self._arrived = asyncio.Event()
        self._processed: Observation | None = None
        self._predicted: deque[int] = deque(maxlen=PREDICTED_MAX)
        self._steps: dict[int, Observation] = {}  # the last ones, by time step
        self._steps_max = 1  # of the policy's history; its first answer says how many

    def offer(self, observation: Observation) -> None:
        """Put an observation into the queue, unless it is not worth an inference."""
        self._steps[observation.timestep] = observation
        while len(self._steps) > self._steps_max:
            del self._steps[min(self._steps)]
        if observation.must_go or self._waiting is not None or self._is_new(observation):
            self._waiting = observation, time.monotonic()
            self._arrived.set()

    def _is_new(self, observation: Observation) -> bool:
        import numpy

        if self._processed is None:
            return True
        moved = observation.values[STATE] - self._processed.values[STATE]
        return observation.timestep not in self._predicted and not (
            float(numpy.linalg.norm(moved)) < SIMILAR
        )

    async def arrival(self, limit_s: float) -> bool:
        """Wait until an observation is in the queue; False after `limit_s`."""
        try:
            async with asyncio.timeout(limit_s):
                await self._arrived.wait()
        except TimeoutError:
            return False
        return True

    async def act(self) -> "tuple[Observation, NDArray[Any]]":
        """Return the observation in the queue, and the actions (T, D) that follow it.

        Raises FrameStale where no model began to look at it within `FRESH_S`, and what the sidecar
        raises.
        """
        assert self._waiting is not None, "it has arrived"
        (observation, came_s), self._waiting = self._waiting, None
        self._arrived.clear()
        self._predicted.append(observation.timestep)
        self._processed = observation
        try:
            answer = await self._sidecar.get_action(
                self._history(observation),
                whole_chunk=True,
                afresh=True,
                fresh_s=max(0.0, FRESH_S - (time.monotonic() - came_s)),
            )
        except BaseException:
            self._processed = None
            raise
        self._steps_max = min(answer.get("n_obs_steps", 1), HISTORY_MAX)
        rows: NDArray[Any] = answer["action"]
        return observation, rows[: self.asked.actions_max]

    def _history(self, newest: Observation) -> dict[str, Any]:
        """Return the control steps that the policy sees, oldest first. In the place of one that the
        robot did not send stands the next one that it sent."""
        if self._steps_max == 1:
            return newest.values
        steps = [newest]
        for number in range(newest.timestep - 1, newest.timestep - self._steps_max, -1):
            steps.insert(0, self._steps.get(number, steps[0]))
        return {
            name: value if name == TASK else [one.values[name] for one in steps]
            for name, value in newest.values.items()
        }
