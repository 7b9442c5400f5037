"""Robot policies through lerobot's classes and processors: observation in, chunk of actions out."""

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import EndpointCall, RealTimeChunking
from vram_arbiter.sidecars.adapters import lingbot
from vram_arbiter.sidecars.adapters.base import DIFFUSERS, LEROBOT, PEFT, Inputs, ModelCall
from vram_arbiter.sidecars.adapters.policy_checks import (
    need_absolute,
    need_statistics,
    need_trained,
    need_weights,
)
from vram_arbiter.sidecars.adapters.policy_families import (
    computing_type,
    family_of,
    need_own_steps,
    need_packages,
    need_type,
)
from vram_arbiter.sidecars.adapters.policy_observations import (
    ACTION,
    Batch,
    Observations,
    misfits,
    observation_of,
)
from vram_arbiter.sidecars.adapters.policy_pace import Pace, pace_of, settle
from vram_arbiter.sidecars.checkpoints import META, load_lerobot
from vram_arbiter.sidecars.quantization import TORCH_NAMES, nf4_of, quantize_linear, torch_type
from vram_arbiter.sidecars.weights import (
    ProcessorFiles,
    Weights,
    fetched,
    model_type,
    read_config,
    reason,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

# own policy types, by lerobot's naming convention
_OWN_POLICIES = ("vram_arbiter.sidecars.models.compact_act",)
_OURS: Final = {
    "pretrained_backbone_weights": None,  # the checkpoint holds these weights, as `load` sees
    "load_vlm_weights": False,
    "vlm_dtype": "float32",  # the whole policy is cast after it was read
    "use_amp": False,
    "use_flash_attn": False,  # it does not compute in float32
    "enable_gradient_checkpointing": False,
    "enable_inference_cuda_graph": False,  # its graphs keep memory that no footprint counts
    "inference_action_mode": "continuous",  # unset in most checkpoints; discrete is refused
}
"""Fields of configurations that the sidecar decides."""
_OWN_CHUNKING: Final = ("groot", "molmoact2")
"""Types whose real-time chunking is not lerobot's, and was not compared with it."""
_LAZY: Final = "proc"
"""GR00T's processor of pictures and texts, read when this property of its step is first asked."""


class Guidance(TypedDict, total=False):
    """Arguments of `predict_action_chunk` for real-time chunking; empty: none."""

    prev_chunk_left_over: "Tensor"  # (1, rows, D), normalized
    inference_delay: int
    execution_horizon: int


class PolicyAdapter:
    """The endpoints `get_action` and `reset`.

    A checkpoint brings its own pre- and postprocessor, so units are the checkpoint's; the manifest
    may name others (`processors`). Observation: `observation.state` (D,),
    `observation.images.CAMERA` uint8 (H, W, 3) RGB or PNG/JPEG bytes, `task` text. Camera names go
    through the manifest's `image_preprocessing.aliases`. Answer: `action` float32 (T, D).

    T is what is played before the next observation, the checkpoint's own `n_action_steps` unless
    the manifest says otherwise (`policy_pace`). A call with `whole_chunk` is answered with all
    actions that were predicted. Policies with `Family.queues` answer what lerobot's
    `select_action` plays before it predicts again, others cut their chunk. A gaussian actor and an
    ACT with temporal ensembling give one action an observation: T is 1.

    The history of a policy with one is lerobot's own queue, which takes an observation at every
    control step. So a call brings all of it: the last `n_obs_steps` control steps in a leading
    dimension, oldest first. A lone observation is taken where lerobot's loop has no other: the
    first of an episode fills the history by repetition, and where T is 1 each call is a control
    step. Any other call is refused: observations that lie T steps apart look T times as fast. A
    call `afresh` is the first of an episode, with as much of its history as is known.
    lerobot's inference server cannot be followed here: it gives one observation to
    `predict_action_chunk`, on which these policies fail.

    Relative actions are relative to the state that their whole chunk was predicted from, as
    lerobot trains them. Its synchronous loop adds the state of the step at which each is played,
    which it calls a defect and refuses (`rollout/inference/sync.py`).

    LingBot-VA's cache takes the observation after every action that it answered, so each call
    after the first has to bring just these (`lingbot.act`).
    """

    kind: Literal["vla"] = "vla"
    ops = frozenset({"get_action", "reset"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        self._manifest = manifest
        self._weights = weights
        self._family = family_of(manifest)
        self._dtype = computing_type(manifest, self._family)
        self._config: Any = None
        self._policy_class: Any = None
        self._policy: Any = None
        self._encoders: tuple[Any, ...] = ()  # networks that are no part of the policy's module
        self._before: Any = None
        self._after: Any = None
        self._observations: Observations | None = None
        self._pace: Pace | None = None
        self._begun = False  # an observation was seen since the last reset
        self._device = "cpu"
        self._guided = False  # lerobot's real-time chunking was enabled

    @property
    def modules(self) -> tuple[str, ...]:
        kind = model_type(self._weights, "type")
        own = f"lerobot.policies.{kind}.modeling_{kind}"
        packages = self._family.packages
        first = PEFT if "peft" in packages else DIFFUSERS if "diffusers" in packages else LEROBOT
        return ("torch", first, own, *_OWN_POLICIES)

    def prepare(self) -> None:
        need_packages(self._manifest)
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class

        for package in _OWN_POLICIES:
            importlib.import_module(package)  # registers itself
        self._weights = fetched(self._weights)
        self._config = read_config(PreTrainedConfig, self._weights)
        need_type(self._manifest, self._family, self._config, self._weights.source)
        self._policy_class = get_policy_class(self._config.type)
        for field, value in _OURS.items():
            if hasattr(self._config, field):
                setattr(self._config, field, value)
        if hasattr(self._config, "use_bf16"):  # GR00T's own autocast
            self._config.use_bf16 = self._dtype is Dtype.BF16
        if self._family.dtype_field is not None:
            setattr(self._config, self._family.dtype_field, TORCH_NAMES[self._dtype])
        if self._family.replays:
            lingbot.settle(self._config, self._weights.source)

    def misfits(self) -> list[str]:
        """Return where the manifest contradicts the checkpoint. After `load`."""
        config = self._config
        assert self._pace is not None
        return [
            *misfits(self._manifest, config.input_features, config.output_features),
            *self._pace.contradictions(self._manifest),
        ]

    @property
    def _has_own_dtype(self) -> bool:
        """Return whether the policy's own code casts: some of its layers then stay float32."""
        return self._family.casts or self._family.dtype_field is not None

    def load(self, device: str) -> None:
        self._config.device = device
        self._config.pretrained_path = self._weights.source
        need_weights(self._weights.source)
        policy = load_lerobot(
            self._policy_class, self._weights, self._config, nf4_of(self._manifest)
        )
        need_trained(self._config.type, self._weights.source)
        pace = pace_of(policy, history=self._family.queues, replays=self._family.replays)
        if device != META and (wrong := pace.contradictions(self._manifest)):
            raise ModelError(
                f"{self._manifest.name}: {'; '.join(wrong)}", hint="correct the manifest"
            )
        self._pace = settle(policy, pace, self._manifest)
        self._guided = self._begun = False
        self._policy = policy if self._has_own_dtype else _cast(policy, torch_type(self._dtype))
        quantize_linear(self._policy, self._manifest, device)
        if self._family.replays:
            self._encoders = lingbot.load_encoders(policy)
        self._make_processors()
        need_absolute(self._after, self._weights.source)
        for pipeline, features in (
            (self._before, self._config.input_features),
            (self._after, self._config.output_features),
        ):
            need_statistics(pipeline, features, self._weights.source, padded=self._family.pads)
        self._observations = Observations(
            self._config.input_features,
            self._manifest.image_preprocessing,
            self._pace.observations,
        )

    @property
    def networks(self) -> Sequence[Any]:
        return (self._policy, *self._encoders)

    def place(self, device: str) -> None:
        self._config.device = self._device = device
        for network in self.networks:
            network.to(device)
        from lerobot.processor import DeviceProcessorStep

        for step in self._before.steps:  # not read again: a tokenizer takes up to a second
            if isinstance(step, DeviceProcessorStep):
                step.device = device
                step.__post_init__()
            elif hasattr(step, _LAZY):
                step.device = device

    def _make_processors(self) -> None:
        """Read the processors, for the CPU. Raises ModelError."""
        from lerobot.policies.factory import make_pre_post_processors

        files = self._weights.processors or ProcessorFiles(
            self._weights.source,
            self._weights.revision,
            "policy_preprocessor.json",
            "policy_postprocessor.json",
        )
        need_own_steps(self._manifest, files)
        try:
            self._before, self._after = make_pre_post_processors(
                self._config,
                pretrained_path=files.source,
                pretrained_revision=files.revision,
                preprocessor_config_filename=files.preprocessor,
                postprocessor_config_filename=files.postprocessor,
                preprocessor_overrides={"device_processor": {"device": "cpu"}},
            )
            for step in self._before.steps:
                getattr(step, _LAZY, None)  # no residency reads files, and none the hub
        except (OSError, ValueError, KeyError, ImportError) as error:
            raise ModelError(
                f"{files.source}: its processors cannot be read: {reason(error)}",
                hint="check that the checkpoint is complete",
            ) from error

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, EndpointCall)
        assert self._pace is not None
        seen, played = self._pace.observations, self._pace.actions
        if call.endpoint == "reset":
            self._forget()
            return {"ok": True, "n_obs_steps": seen, "n_action_steps": played}
        assert self._observations is not None
        steps, told = self._observations.read(observation_of(call)), {}
        if call.afresh:
            self._begin_afresh()
            steps = [steps[0]] * (seen - len(steps)) + steps
            told = {"n_obs_steps": seen}
        actions = self._act(steps, call.rtc)
        return {"action": actions if call.whole_chunk else actions[:played], **told}

    def _forget(self) -> None:
        self._policy.reset()
        self._begun = False

    def _begin_afresh(self) -> None:
        """Raise BadRequest for a policy that needs the observation after each of its actions."""
        if self._family.replays:
            raise BadRequest(
                f"a policy of type {self._config.type} has to see the step after each action",
                hint="serve its robot with a runner: at a door of other projects it cannot be used",
            )
        self._forget()

    def _act(self, steps: list[Batch], rtc: RealTimeChunking | None) -> "NDArray[Any]":
        import torch
        from transformers import BatchFeature

        dtype = torch_type(self._dtype)
        casts = dtype != torch.float32 and not self._has_own_dtype
        guidance: Guidance = {} if rtc is None else self._guidance(steps[-1], rtc)
        with (
            # the guidance is a gradient, which inference mode forbids
            torch.no_grad() if guidance else torch.inference_mode(),
            # operations that the policy's code does in float32 meet weights of another type
            torch.autocast(torch.device(self._device).type, dtype, enabled=casts),
        ):
            inputs: list[Inputs] = [self._before(step) for step in steps]
            if casts:
                inputs = [BatchFeature(dict(batch)).to(dtype).data for batch in inputs]
            chunk = self._predict(inputs, guidance)
            # postprocessors take (B, D), as lerobot's own server does
            rows = [self._after(chunk[:, step].to(torch.float32)) for step in range(chunk.shape[1])]
        actions = torch.stack([row[0] for row in rows]).to(torch.float32).cpu()
        if not bool(torch.isfinite(actions).all()):
            raise ModelError(
                "the policy's actions are not finite numbers", hint="nothing was sent to the robot"
            )
        numbers: NDArray[Any] = actions.numpy()
        return numbers

    def _guidance(self, step: Batch, rtc: RealTimeChunking) -> Guidance:
        """Return the arguments of lerobot's real-time chunking.

        The checkpoint's preprocessor, which normalizes actions in training, turns the left-over
        rows into the policy's own numbers. Raises BadRequest for a policy that is not guided.
        """
        import torch

        compared = self._config.type not in _OWN_CHUNKING
        if self._selects or not compared or not self._policy.supports_rtc():
            raise BadRequest(
                f"a policy of type {self._config.type} takes no left-over chunk",
                hint="leave rtc out of policy_extras in the skill's manifest",
                details={"fields": ["rtc"]},
            )
        width = self._config.output_features[ACTION].shape[0]
        if any(len(row) != width for row in rtc.left_over):
            raise BadRequest(
                f"rows of rtc.left_over must have {width} numbers",
                hint="send the rows of the last answer that were not played",
                details={"fields": ["rtc.left_over"]},
            )
        self._enable_guidance()
        rows = torch.tensor(rtc.left_over, dtype=torch.float32)[None]
        with torch.no_grad():
            left_over = self._before({**step, ACTION: rows})[ACTION]
        return {
            "prev_chunk_left_over": left_over,
            "inference_delay": rtc.inference_delay,
            "execution_horizon": rtc.execution_horizon,
        }

    def _enable_guidance(self) -> None:
        if self._guided:
            return
        from lerobot.policies.rtc.configuration_rtc import RTCConfig

        self._config.rtc_config = RTCConfig()
        if hasattr(self._policy, "init_rtc_processor"):  # others read the configuration
            self._policy.init_rtc_processor()
        self._policy.requires_grad_(False)  # else each step would keep its activations
        self._guided = True

    def _predict(self, steps: Sequence[Inputs], guidance: Guidance) -> "Tensor":
        """Return the actions (B, T, D) after the last of `steps`, which are oldest first."""
        if not self._selects:
            chunk: Tensor = self._policy.predict_action_chunk(dict(steps[-1]), **guidance)
            if self._config.type == "pi0_fast" and not chunk.any():
                raise ModelError(  # lerobot logs the reason and answers zeros
                    "the policy's tokens cannot be decoded into actions",
                    hint="the sidecar's log has the tokens; nothing was sent to the robot",
                )
            return chunk
        if self._family.replays:
            return lingbot.act(self._policy, steps)
        self._need_history(len(steps))
        return _select(self._policy, steps)

    def _need_history(self, given: int) -> None:
        """Raise BadRequest for observations that are not the control steps which lerobot's loop
        would have seen."""
        assert self._pace is not None
        needed, alone = self._pace.observations, not self._begun or self._pace.actions == 1
        if given != needed and not (given == 1 and alone):
            raise BadRequest(
                f"the observation has {given} control steps, but this policy's history needs "
                f"{needed}: one after each action, oldest first",
                hint="send the last ones together, before that the first one repeated; one alone "
                "begins an episode, after reset",
                details={"needed": needed},
            )
        self._begun = True

    @property
    def _selects(self) -> bool:
        ensembles = getattr(self._config, "temporal_ensemble_coeff", None) is not None
        return self._family.queues or ensembles


def _cast(policy: Any, dtype: Any) -> Any:
    """Return the policy with its weights in `dtype`.

    Buffers that no checkpoint holds keep their precision: rotary frequencies in bfloat16 would
    turn far positions into others.
    """
    for module in policy.modules():
        for parameter in module.parameters(recurse=False):
            if parameter.is_floating_point():
                parameter.data = parameter.data.to(dtype)
        for name, buffer in module.named_buffers(recurse=False):
            if buffer.is_floating_point() and name not in module._non_persistent_buffers_set:
                module._buffers[name] = buffer.to(dtype)
    return policy


def _select(policy: Any, steps: Sequence[Inputs]) -> "Tensor":
    """Return the actions (B, T, D) that `select_action` plays until it would predict again.

    While an action is queued, `select_action` only records the observation: that is how all steps
    but the last reach the history.
    """
    import torch

    queue: Any = getattr(policy, "_queues", {}).get(ACTION)
    for step in steps[:-1]:
        queue.append(torch.empty(0))
        policy.select_action(dict(step))
    rows = [policy.select_action(dict(steps[-1]))]
    if queue is not None:
        rows += queue
        queue.clear()
    return torch.stack(rows, dim=1)
