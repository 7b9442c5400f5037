"""Pre- and postprocessing of the compact progress model: the instruction's words, the device."""

import re
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import (
    DeviceProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    policy_action_to_transition,
)

from vram_arbiter.sidecars.models.compact_progress.configuration_compact_progress import (
    CompactProgressConfig,
)
from vram_arbiter.sidecars.models.compact_progress.modeling_compact_progress import WORDS_KEY


def words_of(task: str, colours: list[str], shapes: list[str]) -> list[float]:
    """Return ones where the instruction has the word.

    Raises ValueError unless it names one object by one color and one shape.
    """
    said = set(re.findall(r"[a-z]+", task.lower()))
    found = [[word for word in known if word in said] for known in (colours, shapes)]
    if any(len(words) != 1 for words in found):
        raise ValueError(
            f"{task!r} does not name one object by color and shape; the colors are "
            f"{', '.join(colours)}, the shapes {', '.join(shapes)}"
        )
    return [float(word in said) for word in (*colours, *shapes)]


@dataclass
@ProcessorStepRegistry.register(name="compact_progress_words")
class WordsStep(ProcessorStep):  # type: ignore[misc]
    """Reader of `task` (a text or a list of them) that adds the named object to the observation."""

    colours: list[str] = field(default_factory=list)
    shapes: list[str] = field(default_factory=list)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        task = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task", "")
        tasks = [task] if isinstance(task, str) else list(task)
        rows = [words_of(text, self.colours, self.shapes) for text in tasks]
        changed = transition.copy()
        changed[TransitionKey.OBSERVATION] = {
            **(transition.get(TransitionKey.OBSERVATION) or {}),
            WORDS_KEY: torch.tensor(rows),
        }
        return changed

    def transform_features(self, features: Any) -> Any:
        return features

    def get_config(self) -> dict[str, list[str]]:
        return {"colours": self.colours, "shapes": self.shapes}


def make_compact_progress_pre_post_processors(
    config: CompactProgressConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return both pipelines; lerobot's factory finds this function by its name.

    Nothing is normalized.
    """
    del dataset_stats
    before = PolicyProcessorPipeline(
        steps=[WordsStep(config.colours, config.shapes), DeviceProcessorStep(device=config.device)],
        name="policy_preprocessor",
    )
    after = PolicyProcessorPipeline(
        steps=[], name="policy_postprocessor", to_transition=policy_action_to_transition
    )
    return before, after
