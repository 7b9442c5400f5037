"""A leader arm without hardware, as a third-party package of lerobot brings one: it is led along
poses of a file.
"""

import json
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig


@TeleoperatorConfig.register_subclass("track")
@dataclass(kw_only=True)
class TrackConfig(TeleoperatorConfig):
    """`path`: a JSON list of poses (values by feature, in lerobot's units), read on connecting;
    one follows another after `step_s` seconds, and the last one stays.
    """

    path: str
    joints: list[str]
    step_s: float


class Track(Teleoperator):
    config_class = TrackConfig
    name = "track"

    def __init__(self, config: TrackConfig) -> None:
        super().__init__(config)
        self.config = config
        self._poses: list[dict[str, float]] = []
        self._since_s = 0.0

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys([f"{name}.pos" for name in self.config.joints], float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return bool(self._poses)

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._poses = json.loads(Path(self.config.path).read_text(encoding="utf-8"))
        self._since_s = time.monotonic()

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, float]:
        """Return the pose of this moment, straight between two of the file."""
        at = (time.monotonic() - self._since_s) / self.config.step_s
        for number, (here, there) in enumerate(pairwise(self._poses)):
            if at < number + 1:
                return {key: here[key] + (at - number) * (there[key] - here[key]) for key in here}
        return self._poses[-1]

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self._poses = []
