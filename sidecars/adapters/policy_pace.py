"""Pace of a policy: how many observations it sees and how many actions of a chunk are played.

lerobot's loop (`select_action` at every control step) decides both by the checkpoint; a manifest
may say otherwise where the checkpoint allows it.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.manifest import RSkillManifest

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy

_CHUNKS: Final = ("horizon", "action_chunk_size", "chunk_size")
"""Fields of configurations with the length of a prediction. A `horizon` counts from the oldest
observation on."""
_SHORTER: Final = ("pi0_fast", "groot", "molmoact2")
"""Types that answer `n_action_steps` of their chunk."""


@dataclass(frozen=True, slots=True)
class Pace:
    """`observations`: consecutive control steps that the policy sees. `actions`: how many actions
    are played before it sees the next ones, at most `most` of the `chunk` that it predicts.
    `replays`: it sees the control step after every action instead, and all are played."""

    observations: int
    actions: int
    most: int
    chunk: int
    replays: bool = False

    def contradictions(self, manifest: RSkillManifest) -> list[str]:
        """Return where a manifest asks for what the checkpoint does not allow."""
        found = []
        extras, steps = manifest.policy_extras, manifest.n_action_steps
        seen = extras.get("n_obs_steps", self.observations)
        if seen != self.observations and not self.replays:
            found.append(
                f"policy_extras.n_obs_steps is {seen}, the checkpoint sees {self.observations} "
                "control steps"
            )
        if steps is not None and (steps > self.most or (self.replays and steps != self.most)):
            found.append(f"n_action_steps is {steps}, the checkpoint allows {self.most}")
        if self.replays and extras.get("prefetch_at"):
            found.append(
                "policy_extras.prefetch_at is set, the checkpoint has to play whole chunks"
            )
        if manifest.chunk_size > self.chunk:
            found.append(
                f"chunk_size is {manifest.chunk_size}, the checkpoint answers {self.chunk}"
            )
        return found


def pace_of(policy: "PreTrainedPolicy", *, history: bool, replays: bool) -> Pace:
    """Return the checkpoint's own pace. `history`: the policy keeps observations between calls."""
    config: Any = policy.config
    queue: Any = getattr(policy, "_queues", {}).get(
        "action", getattr(policy, "_action_queue", None)
    )
    actions = 1 if queue is None else queue.maxlen
    chunk = next((getattr(config, name) for name in _CHUNKS if hasattr(config, name)), 1)
    most = chunk
    repeats = getattr(config, "n_action_repeats", 1) > 1
    if queue is None or repeats or not getattr(config, "use_mpc", True):
        most = actions  # one action an observation, which TDMPC may repeat
    elif config.type in _SHORTER:
        most = config.n_action_steps
    elif hasattr(config, "horizon"):
        most = chunk - config.n_obs_steps + 1
    observations = config.n_obs_steps if history else 1
    return Pace(chunk if replays else observations, min(actions, most), most, chunk, replays)


def settle(policy: "PreTrainedPolicy", pace: Pace, manifest: RSkillManifest) -> Pace:
    """Return the manifest's pace, and make the policy predict as many actions as it plays."""
    asked = manifest.n_action_steps
    if asked is None or asked > pace.most:
        return pace
    if asked > pace.actions and hasattr(policy.config, "horizon"):
        policy.config.n_action_steps = asked
        policy.reset()
    return replace(pace, actions=asked)
