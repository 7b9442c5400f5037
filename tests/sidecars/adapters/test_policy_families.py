"""Every policy family that is served, loaded as in production, against lerobot itself.

A tiny checkpoint of each family is saved by lerobot (`policies.py`); tools of these tests are in
`families.py`. The reference is the robot's own loop in lerobot: preprocess, `select_action`,
postprocess, at every control step. A usual run plays four families, `make nightly` all.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters import policies
from tests.sidecars.adapters.families import (
    NAMES,
    SEED,
    answered_episode,
    ask,
    begin,
    copied,
    family_of,
    history,
    is_refused,
    lerobots_own,
    load_policy,
    manifest_of,
    manifest_text,
    observations,
    prepared,
    stacked,
    swept,
)
from tests.sidecars.adapters.policies import DIM, FRONT, ONLY_CAMERA, STATE
from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError, UnsupportedQuantization
from vram_arbiter.schemas.manifest import ModelFamily, parse_manifest
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.policy import PolicyAdapter
from vram_arbiter.sidecars.adapters.policy_families import FAMILIES
from vram_arbiter.sidecars.host_weights import HostWeights
from vram_arbiter.sidecars.settings import read_model
from vram_arbiter.sidecars.weights import Weights

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("small_networks")]

ROWS = {  # actions in one answer, else 3: the checkpoint's n_action_steps
    "act ensembling": 1, "diffusion": 4, "vqbet": 4, "tdmpc": 2, "gaussian_actor": 1,
    "multi_task_dit": 4, "lingbot_va": 4,
}  # fmt: skip
WHOLE = ("act", "smolvla", "pi0", "pi05", "xvla", "eo1", "evo1", "vla_jepa", "wall_x")
CHUNK_ROWS = 5  # of these, where the whole chunk is asked for
NOT_SERVED = {
    "openvla": "", "fastwam": "hub repository whose name is fixed in its code",
}  # fmt: skip


@pytest.mark.parametrize("name", swept(name for name in NAMES if name != "lingbot_va"))
def test_actions_are_lerobots_own(checkpoint: Callable[[str], Weights], name: str) -> None:
    """Regression: policies with an observation history loaded, passed `--check`, and failed at the
    first `get_action`. Then chunks were played whole where lerobot plays 3 of 5."""
    import numpy as np

    weights = checkpoint(name)
    adapter = load_policy(name, weights)
    rows = ROWS.get(name, 3)
    steps = observations(2 * rows + 1)

    expected = lerobots_own(weights, steps)
    for goal in range(2):
        np.testing.assert_array_equal(answered_episode(adapter, steps), expected, f"goal {goal}")
    length, played = begin(adapter)
    assert played == rows
    assert (length > 1) is (name in ("diffusion", "vqbet", "multi_task_dit"))
    assert ask(adapter, steps[0]).shape == (rows, DIM)
    begin(adapter)
    whole = ask(adapter, steps[0], whole_chunk=True)
    assert whole.shape == (CHUNK_ROWS if name in WHOLE else rows, DIM)


MOST = {  # most actions of a chunk that may be played, and its length
    "act": (5, 5), "act ensembling": (1, 5), "diffusion": (7, 8), "vqbet": (4, 4), "tdmpc": (2, 5),
    "gaussian_actor": (1, 1), "multi_task_dit": (7, 8), "smolvla": (5, 5), "pi0_fast": (3, 5),
}  # fmt: skip


@pytest.mark.parametrize("name", swept(MOST))
def test_a_manifest_may_say_how_many_actions_are_played(
    checkpoint: Callable[[str], Weights], name: str
) -> None:
    """Regression: a diffusion policy answered what its checkpoint plays, whatever the manifest
    said, and contradictions were `ok`."""
    import numpy as np

    weights = checkpoint(name)
    most, chunk = MOST[name]
    adapter = load_policy(name, weights, n_action_steps=most, chunk_size=chunk)
    assert not [line for line in adapter.misfits() if "steps" in line or "chunk" in line]
    length, played = begin(adapter)
    assert played == most
    if hasattr(adapter._config, "horizon") and name != "tdmpc":
        steps = observations(2 * most + 1)
        expected = lerobots_own(weights, steps, n_action_steps=most)
        np.testing.assert_array_equal(answered_episode(adapter, steps), expected)
    for fields, told in (
        ({"n_action_steps": most + 1}, f"is {most + 1}, the checkpoint allows {most}"),
        ({"chunk_size": chunk + 1}, f"is {chunk + 1}, the checkpoint answers {chunk}"),
        ({"policy_extras": {"n_obs_steps": length + 1}}, f"the checkpoint sees {length} control"),
    ):
        wrong = prepared(manifest_of(name, **fields), weights)
        wrong.load("meta")
        assert [line for line in wrong.misfits() if told in line], "what `--check` says"
        with pytest.raises(ModelError, match=told):
            wrong.load("cpu")


def test_a_history_takes_every_control_step_or_refuses(
    checkpoint: Callable[[str], Weights],
) -> None:
    """Regression: observations a chunk apart entered the history as if one control step lay
    between them, and the robot moved on the answer."""
    import numpy as np

    weights = checkpoint("diffusion")
    steps = observations(4)
    adapter = load_policy("diffusion", weights)
    first = ask(adapter, steps[0])
    for count in (1, 3):
        with pytest.raises(BadRequest, match=f"has {count} control steps|takes up to 2"):
            ask(adapter, stacked(steps[:count]))
    with pytest.raises(BadRequest, match="of all inputs alike"):
        ask(adapter, stacked(steps[:2]) | {STATE: steps[0][STATE]})
    assert ask(adapter, stacked(steps[2:])).shape == first.shape, "all of it, whatever was before"
    single = load_policy("diffusion", weights, n_action_steps=1)
    expected = lerobots_own(weights, steps, n_action_steps=1)
    np.testing.assert_array_equal(answered_episode(single, steps), expected)
    begin(single)
    import torch

    torch.manual_seed(SEED)
    alone = [ask(single, step)[0] for step in steps]
    np.testing.assert_array_equal(np.stack(alone), expected, "each of them is a control step")


@pytest.mark.parametrize("name", ["diffusion", "tdmpc", "act ensembling"])
def test_a_call_afresh_depends_on_no_other_one(
    checkpoint: Callable[[str], Weights], name: str
) -> None:
    """Robots of other projects share a policy: the answer to one was smoothed with another's."""
    import numpy as np
    import torch

    adapter = load_policy(name, checkpoint(name))
    length, _ = begin(adapter)
    steps = observations(6)

    def afresh(observation: dict[str, Any]) -> Any:
        torch.manual_seed(SEED)
        data = {"observation": observation}
        answer = adapter.run(EndpointCall(endpoint="get_action", data=data, afresh=True))
        assert answer["n_obs_steps"] == length
        return answer["action"]

    torch.manual_seed(SEED)
    first = ask(adapter, steps[0])
    ask(adapter, history(steps, 3, length))
    np.testing.assert_array_equal(afresh(steps[0]), first, "as the first of an episode")
    with_history = afresh(history(steps, 4, length))
    np.testing.assert_array_equal(afresh(history(steps, 4, length)), with_history)
    assert length == 1 or (afresh(steps[4]) != with_history).any(), "what it saw before counts"


@pytest.mark.nightly
def test_lingbot_replays_every_control_step(checkpoint: Callable[[str], Weights]) -> None:
    """Its cache takes the observations after its own actions: one too few or too many, and all
    later actions would be others than lerobot's.

    The encoders are shared, placed and counted as the policy is.
    """
    import numpy as np
    import torch

    weights = checkpoint("lingbot_va")
    adapter = load_policy("lingbot_va", weights)
    assert len(adapter.networks) == 3
    shared = HostWeights(adapter.networks, "test")
    sizes = [sum(p.nbytes for p in network.parameters()) for network in adapter.networks]
    assert shared.size_bytes >= sum(sizes)
    shared.own()
    adapter.place("cpu")
    steps = observations(4 + 8 + 8)
    expected = lerobots_own(weights, steps)
    for goal in range(2):
        torch.manual_seed(SEED)
        with pytest.raises(BadRequest, match=r"has 2 control steps, .* needs 1"):
            ask(adapter, stacked(steps[:2]))
        actions = list(ask(adapter, steps[0]))
        for wrong in (steps[1:4], steps[:5]):  # asked too early; an observation twice
            with pytest.raises(BadRequest, match=rf"has {len(wrong)} control steps, .* needs 4"):
                ask(adapter, stacked(wrong))
        actions += [*ask(adapter, stacked(steps[1:5])), *ask(adapter, stacked(steps[5:13]))]
        np.testing.assert_array_equal(np.stack(actions), expected, f"goal {goal}")
        adapter.run(EndpointCall(endpoint="reset"))
    np.testing.assert_array_equal(answered_episode(adapter, steps), expected, "as the runner asks")
    assert begin(adapter) == (8, 8)
    policy = adapter._policy
    ask(adapter, steps[0])
    encode, policy._encode_frames = policy._encode_frames, None  # fails within an answer
    with pytest.raises(TypeError):
        ask(adapter, stacked(steps[1:5]))
    policy._encode_frames = encode
    torch.manual_seed(SEED)
    np.testing.assert_array_equal(ask(adapter, steps[0]), expected[:4], "a new episode")
    with pytest.raises(BadRequest, match="has to see the step after each action"):
        adapter.run(
            EndpointCall(endpoint="get_action", data={"observation": steps[0]}, afresh=True)
        )
    adapter.load("meta")
    meta = [sum(p.nbytes for p in network.parameters()) for network in adapter.networks]
    assert meta == sizes


@pytest.mark.nightly
def test_lingbot_needs_its_encoders(checkpoint: Callable[[str], Weights], tmp_path: Path) -> None:
    """diffusers and transformers fill a gap in a checkpoint with random numbers."""
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "lingbot"
    weights = copied(checkpoint("lingbot_va"), folder)
    config = folder / "config.json"
    text = config.read_text()

    def changed(**changes: Any) -> PolicyAdapter:
        config.write_text(json.dumps(json.loads(text) | changes))
        return prepared(manifest_of("lingbot_va"), weights)

    nowhere, top = "robbyant/lingbot-va-base", "observation.images.top"
    for field, value, told in (
        ("wan_pretrained_path", nowhere, f"'{nowhere}' is not a local folder with vae"),
        ("camera_layout", "robotwin_tshape", "camera_layout: robotwin_tshape is not served"),
        ("action_per_frame", 16, "2 frames and 32 actions a chunk is not served"),
        ("obs_cam_keys", [top], f"obs_cam_keys names {top}"),
    ):
        with pytest.raises(ModelError, match=told):
            changed(**{field: value})
    with pytest.raises(UnsupportedQuantization, match="is not quantized"):
        make_adapter(manifest_of("lingbot_va", "int4"), weights)
    adapter = changed(wan_pretrained_path="wan")  # beside the checkpoint
    for part in ("vae/diffusion_pytorch_model", "text_encoder/model"):
        file = folder / "wan" / f"{part}.safetensors"
        tensors = load_file(file)
        dropped = sorted(tensors)[0]
        for device in ("cpu", "meta"):
            save_file({key: tensors[key] for key in tensors if key != dropped}, file)
            with pytest.raises(ModelError, match="missing from it"):
                adapter.load(device)
            file.unlink()
            with pytest.raises(ModelError):
                adapter.load(device)
        save_file(tensors, file, {"format": "pt"})
    (folder / "wan/tokenizer/tokenizer.json").unlink()
    with pytest.raises(ModelError, match=r"tokenizer has none of tokenizer\.json"):
        changed(wan_pretrained_path="wan")


@pytest.mark.parametrize("name", ["pi0", "pi05"])
def test_relative_actions_are_relative_to_the_state_of_their_chunk(
    checkpoint: Callable[[str], Weights], tmp_path: Path, name: str
) -> None:
    """lerobot has both: its real-time engine and its server anchor a chunk at the state that it was
    predicted from, as in training; `select_action` with a preprocessor at every step adds a newer
    state to each row, which lerobot calls drift and refuses (`SyncInferenceEngine`)."""
    import numpy as np
    import torch
    from lerobot.policies.rtc import reanchor_relative_rtc_prefix
    from lerobot.processor import NormalizerProcessorStep, RelativeActionsProcessorStep

    weights = copied(checkpoint(name), tmp_path / name)
    for file in (tmp_path / name).glob("policy_*processor.json"):
        file.write_text(file.read_text().replace('"enabled": false', '"enabled": true'))
    adapter = load_policy(name, weights)
    steps = observations(3)

    anchored = answered_episode(adapter, steps)
    drifting = lerobots_own(weights, steps)
    np.testing.assert_array_equal(anchored[0], drifting[0])
    moved = np.stack([step[STATE] - steps[0][STATE] for step in steps])
    np.testing.assert_allclose(drifting - anchored, moved, atol=1e-5)

    relative = next(s for s in adapter._before.steps if isinstance(s, RelativeActionsProcessorStep))
    normal = next(s for s in adapter._before.steps if isinstance(s, NormalizerProcessorStep))
    heard: list[Any] = []
    predict = adapter._policy.predict_action_chunk

    def hear(batch: Any, **guidance: Any) -> Any:
        heard.append((predict(batch, **guidance), guidance))
        return heard[-1][0]

    adapter._policy.predict_action_chunk = hear
    rtc = {"left_over": anchored.tolist(), "inference_delay": 1, "execution_horizon": 3}
    call = {"endpoint": "get_action", "data": {"observation": steps[1]}, "rtc": rtc}
    answer = adapter.run(EndpointCall.model_validate(call))["action"]
    (chunk, guidance) = heard[0]
    whole = adapter._after(chunk)[0, : len(answer)].numpy()  # as lerobot's engine does
    np.testing.assert_array_equal(answer, whole)
    expected = reanchor_relative_rtc_prefix(
        torch.from_numpy(anchored), torch.from_numpy(steps[1][STATE]), relative, normal, "cpu"
    )
    np.testing.assert_allclose(guidance["prev_chunk_left_over"][0], expected, atol=1e-6)


def change(folder: Path, pattern: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Rewrite the tensors of the files of a checkpoint that match."""
    from safetensors.torch import load_file, save_file

    files = list(folder.glob(pattern))
    assert files
    for file in files:
        save_file(change(load_file(file)), file, {"format": "pt"})


STATISTICS: dict[str, tuple[str, Callable[[Any, Any], dict[str, Any]], str]] = {
    "missing": ("act", lambda name, _: {name: None}, "no std"),
    "no mean": ("act", lambda name, _: {name.replace(".std", ".mean"): None}, "no mean"),
    "too long": ("act", lambda name, x: {name: x.repeat(2)}, r"std has shape \(12,\), not \(6,\)"),
    "broadcast": ("act", lambda name, x: {name: x[:1]}, r"std has shape \(1,\), not \(6,\)"),
    "a number": ("act", lambda name, x: {name: x[0].clone()}, r"std has shape \(\), not"),
    "zero": ("act", lambda name, x: {name: 0 * x}, "std is 0 or less"),
    "negative": ("act", lambda name, x: {name: x.cumsum(0) - 3}, "std is 0 or less"),
    "not finite": ("act", lambda name, x: {name: x / 0}, "std has NaN or infinity"),
    "no max": ("diffusion", lambda name, _: {name: None}, "no max"),
    "below min": ("diffusion", lambda name, x: {name: -x - 9}, "max is below min"),
    "NaN": ("diffusion", lambda name, x: {name: x * float("nan")}, "max has NaN"),
    "no quantile": ("pi05", lambda name, _: {name: None}, "no q99"),
}
WORDS = {"act": "std", "diffusion": "max", "pi05": "q99"}


@pytest.mark.parametrize("case", STATISTICS)
def test_statistics_that_cannot_convert_are_refused(
    checkpoint: Callable[[str], Weights], tmp_path: Path, case: str
) -> None:
    """Regression: load and `--check` accepted them; lerobot fails, or moves the robot, at the first
    action."""
    name, damage, told = STATISTICS[case]
    for feature, step in ((STATE, "preprocessor"), ("action", "postprocessor")):
        folder = tmp_path / step
        weights = copied(checkpoint(name), folder)
        key = f"{feature}.{WORDS[name]}"

        def damaged(tensors: dict[str, Any], key: str = key) -> dict[str, Any]:
            changed = tensors | damage(key, tensors[key])
            return {one: tensor for one, tensor in changed.items() if tensor is not None}

        change(folder, f"policy_{step}*.safetensors", damaged)
        adapter = prepared(manifest_of(name), weights)
        is_refused(adapter, f"convert {feature}: {told}")
        if case == "missing":
            next(folder.glob(f"policy_{step}*.safetensors")).unlink()
            is_refused(adapter, "its processors cannot be read")


@pytest.mark.parametrize("name", ["act", "diffusion"])
def test_an_action_that_never_moved_is_no_defect(
    checkpoint: Callable[[str], Weights], tmp_path: Path, name: str
) -> None:
    """A joint that stood still in all episodes has a standard deviation of 0, or equal bounds: it
    is kept there. An observation of it would be divided by almost nothing."""
    import numpy as np

    folder = tmp_path / name
    weights = copied(checkpoint(name), folder)

    def still(tensors: dict[str, Any], feature: str = "action") -> dict[str, Any]:
        for word, values in ((f"{feature}.std", 0.0), (f"{feature}.max", -1.0)):
            tensors[word][2] = values
        return tensors

    change(folder, "policy_*.safetensors", still)
    steps = observations(3)
    found = answered_episode(load_policy(name, weights), steps)
    np.testing.assert_array_equal(found, lerobots_own(weights, steps))
    assert np.ptp(found[:, 2]) < 1e-6
    change(folder, "policy_pre*.safetensors", lambda tensors: still(tensors, STATE))
    if name == "act":
        with pytest.raises(ModelError, match=f"convert {STATE}: std is 0 or less"):
            load_policy(name, weights)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(
    checkpoint: Callable[[str], Weights], tmp_path: Path, number: float
) -> None:
    """Regression: such a checkpoint was `ok` and loaded, and failed at the first action."""
    folder = tmp_path / "act"
    weights = copied(checkpoint("act"), folder)
    key = "model.action_head.weight"

    def damaged(tensors: dict[str, Any]) -> dict[str, Any]:
        tensors[key][0, 3] = number
        return tensors

    change(folder, "model.safetensors", damaged)
    is_refused(prepared(manifest_of("act"), weights), rf"1 with NaN or infinity \({key}\)")


@pytest.mark.parametrize("name", swept(name for name in NAMES if name != "act ensembling"))
def test_each_precision_of_the_table(checkpoint: Callable[[str], Weights], name: str) -> None:
    """The manifest's number format is the one that the weights have after loading."""
    import torch

    weights = checkpoint(name)
    supported = FAMILIES[family_of(name)].precisions
    (observation,) = observations(1)
    for dtype in sorted({"bf16", "fp16"} & supported):
        adapter = load_policy(name, weights, dtype)
        wanted = {"bf16": torch.bfloat16, "fp16": torch.float16}[dtype]
        kinds = {tensor.dtype for tensor in adapter.networks[0].parameters()}
        assert wanted in kinds
        assert kinds == {wanted} or adapter._has_own_dtype
        if not adapter._has_own_dtype:  # rotary frequencies in 8 bits lose far positions
            buffers = dict(adapter.networks[0].named_buffers())
            assert all(buffers[key].dtype == torch.float32 for key in buffers if "inv_freq" in key)
        assert ask(adapter, observation).shape == (ROWS.get(name, 3), DIM)
    for dtype in sorted({"fp32", "fp16", "int8", "fp8", "fp4_nvfp4"} - supported):
        with pytest.raises(UnsupportedQuantization, match=dtype):
            make_adapter(manifest_of(name, dtype), weights)


@pytest.mark.parametrize("name", swept(["act", "tdmpc", "smolvla", "pi05"]))
def test_linear_layers_in_nf4(checkpoint: Callable[[str], Weights], name: str) -> None:
    """int4 is NF4 as for every other model: chosen by the manifest, or refused, never bf16."""
    pytest.importorskip("bitsandbytes")
    from vram_arbiter.sidecars.quantization import nf4_layers

    weights = checkpoint(name)
    last = {"act": "action_head", "tdmpc": "_reward"}.get(name, "action_out_proj")
    extra = f", min_params_to_quantize: 64, skip_modules: [{last}]"
    adapter = prepared(parse_manifest(manifest_text(family_of(name), "int4", extra=extra)), weights)
    adapter.load("meta")
    adapter.load("cpu")
    adapter.place("cpu")
    layers = nf4_layers(adapter.networks[0])
    assert layers
    assert not any(last in layer for layer in layers)
    assert ask(adapter, observations(1)[0]).shape == (ROWS.get(name, 3), DIM)
    adapter = prepared(manifest_of(name, "int4"), weights)  # 4,000,000 weights and more
    is_refused(adapter, "no linear layer to quantize", UnsupportedQuantization)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_a_quantized_layer_takes_the_numbers_of_autocast(tmp_path: Path, dtype: str) -> None:
    """Regression: ACT makes its latent vector in float32, bitsandbytes answered in that, and the
    next layer refused it at the first action."""
    pytest.importorskip("bitsandbytes")
    policies.save_act(tmp_path, latent_dim=8)
    extra = f", min_params_to_quantize: 64, compute_dtype: {dtype}"
    manifest = parse_manifest(manifest_text("act", "int4", extra=extra))
    adapter = prepared(manifest, Weights(str(tmp_path), local=True))
    adapter.load("cpu")
    adapter.place("cpu")
    assert ask(adapter, observations(1)[0]).shape == (3, DIM)


@pytest.mark.parametrize("name", swept(name for name in NAMES if not name.startswith("act")))
def test_an_incomplete_policy_is_refused(
    checkpoint: Callable[[str], Weights], tmp_path: Path, name: str
) -> None:
    """lerobot's loaders differ: some fill gaps with random numbers, some swallow a missing file."""
    import torch
    from safetensors.torch import load_file, save_file

    weights = copied(checkpoint(name), tmp_path / "clip")
    file = tmp_path / "clip" / "model.safetensors"
    tensors = load_file(file)
    adapter = prepared(manifest_of(name), weights)
    adapter.load("meta")
    dropped = sorted(tensors)[0]
    kept = {key: tensors[key] for key in tensors if key != dropped}
    save_file(kept | {"another.models.weight": torch.zeros(3)}, file)
    is_refused(adapter, r"missing from it .*unknown to the model \(.*another.models")
    file.unlink()
    is_refused(adapter, "has no model.safetensors")


def test_every_type_of_lerobot_is_named() -> None:
    """A new type in lerobot has to be looked at before a manifest can name it."""
    import lerobot.policies  # noqa: F401  registers the types
    from lerobot.configs.policies import PreTrainedConfig

    served = {kind for family in FAMILIES.values() for kind in family.types}
    field = {family.value for family in ModelFamily} | {"groot"}  # the field writes gr00t
    assert set(PreTrainedConfig.get_known_choices()) <= served | field
    assert served <= set(PreTrainedConfig.get_known_choices())


def test_the_manifests_family_decides(
    checkpoint: Callable[[str], Weights], monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = checkpoint("tdmpc")
    adapter = make_adapter(manifest_of("vqbet"), weights)
    with pytest.raises(ModelError, match="'tdmpc', but test/model names model_family vqbet"):
        adapter.prepare()
    for family, why in NOT_SERVED.items():
        with pytest.raises(ConfigError, match=f"'{family}' is not served.*{why}"):
            make_adapter(manifest_of(family), weights)
    with pytest.raises(ConfigError, match="Python code of the hub"):
        make_adapter(
            parse_manifest(manifest_text("pi0_fast").replace("_code: true", "_code: false")),
            weights,
        )
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="of family diffusion needs diffusers, which"):
        make_adapter(manifest_of("diffusion"), weights).prepare()


def test_what_cannot_act_is_refused(checkpoint: Callable[[str], Weights], tmp_path: Path) -> None:
    """lerobot only warns of a VQ-BeT in its first stage of training, and its actions are noise."""
    import torch

    folder = tmp_path / "vqbet"
    weights = copied(checkpoint("vqbet"), folder)
    flag = {"vqbet.action_head.vqvae_model.discretized": torch.tensor(False)}
    change(folder, "model.safetensors", lambda tensors: tensors | flag)
    # regression: `--check` was ok
    is_refused(
        prepared(manifest_of("vqbet"), weights), "the quantizer of its actions is not trained"
    )
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"use_peft": false', '"use_peft": true'))
    with pytest.raises(ModelError, match="is a PEFT adapter"):
        load_policy("vqbet", weights)


@pytest.mark.parametrize(
    "step",
    [
        '"class": "subprocess.Popen", "config": {"args": ["touch", "TOUCHED"]}',
        '"registry_name": "action_tokenizer_processor", "config": {"trust_remote_code": true}',
    ],
)
def test_a_processor_runs_no_code_of_others(
    checkpoint: Callable[[str], Weights], tmp_path: Path, step: str
) -> None:
    """Regression: lerobot imports and calls whatever class a checkpoint's processor names."""
    weights = copied(checkpoint("tdmpc"), tmp_path / "tdmpc")
    file = tmp_path / "tdmpc" / "policy_preprocessor.json"
    touched = tmp_path / "touched"
    text = file.read_text().replace(
        '"steps": [', f'"steps": [{{{step.replace("TOUCHED", str(touched))}}},'
    )
    file.write_text(text)
    manifest = parse_manifest(
        manifest_text("tdmpc").replace("trust_remote_code: true", "trust_remote_code: false")
    )
    adapter = prepared(manifest, weights)
    with pytest.raises(ModelError, match="runs other code than lerobot's"):
        adapter.load("cpu")
    assert not touched.exists()


@pytest.mark.parametrize("name", swept(["smolvla", "pi05", "evo1"]))
def test_a_guided_chunk_continues_the_one_before(
    checkpoint: Callable[[str], Weights], name: str
) -> None:
    """lerobot guides a chunk to its left-over rows, which have to be in the policy's own numbers:
    rows as they were answered, in the robot's units, would draw it somewhere else.
    """
    import numpy as np
    import torch

    adapter = load_policy(name, checkpoint(name))
    observation = observations(1)[0]
    left_over = np.random.default_rng(2).normal(3.0, 2.0, (4, DIM)).astype(np.float32)
    policy = adapter._policy

    def answer(rtc: dict[str, Any] | None) -> Any:
        torch.manual_seed(SEED)
        call = {"endpoint": "get_action", "data": {"observation": observation}}
        return adapter.run(EndpointCall.model_validate(call | ({"rtc": rtc} if rtc else {})))

    free = answer(None)["action"]
    heard: list[Any] = []
    predict = policy.predict_action_chunk

    def hear(batch: Any, **guidance: Any) -> Any:
        heard.append(guidance)
        return predict(batch, **guidance)

    policy.predict_action_chunk = hear
    rtc = {"left_over": left_over.tolist(), "inference_delay": 3, "execution_horizon": 4}
    guided = answer(rtc)["action"]
    off = [np.abs(chunk[:3] - left_over[:3]).mean() for chunk in (guided, free)]
    assert off[0] < off[1] / 2, "its first rows are those that are played meanwhile"
    assert not any(parameter.requires_grad for parameter in policy.parameters())
    told = adapter._after(heard[0]["prev_chunk_left_over"][:, 0])[0]
    np.testing.assert_allclose(told, left_over[0], rtol=1e-4)
    np.testing.assert_array_equal(answer(None)["action"], free)
    with pytest.raises(BadRequest, match="must have 6 numbers"):
        answer(rtc | {"left_over": [[0.0]]})


@pytest.mark.parametrize("name", ["act", "act ensembling", "diffusion"])
def test_a_policy_that_cannot_be_guided_refuses_a_left_over_chunk(
    checkpoint: Callable[[str], Weights], name: str
) -> None:
    adapter = load_policy(name, checkpoint(name))
    rtc = {"left_over": [[0.0] * DIM], "inference_delay": 1, "execution_horizon": 1}
    data = {"observation": observations(1)[0]}
    with pytest.raises(BadRequest, match="takes no left-over chunk"):
        adapter.run(
            EndpointCall.model_validate({"endpoint": "get_action", "data": data, "rtc": rtc})
        )


def test_tokens_that_are_no_actions_never_leave(
    checkpoint: Callable[[str], Weights], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: lerobot logs the failure and answers the middle of each joint's range."""
    adapter = load_policy("pi0_fast", checkpoint("pi0_fast"))
    monkeypatch.setattr(policies.FastTokenizer, "decode", lambda self, tokens: None)
    with pytest.raises(ModelError, match="cannot be decoded into actions"):
        ask(adapter, observations(1)[0])


def test_a_camera_that_tdmpc_does_not_find_is_refused(
    checkpoint: Callable[[str], Weights], tmp_path: Path
) -> None:
    """Regression: such a checkpoint loaded and failed at the first `get_action`."""
    weights = copied(checkpoint("tdmpc"), tmp_path / "tdmpc")
    config = tmp_path / "tdmpc" / "config.json"
    config.write_text(config.read_text().replace(ONLY_CAMERA, FRONT))
    adapter = make_adapter(manifest_of("tdmpc"), weights)
    with pytest.raises(ModelError, match=r"front; lerobot's tdmpc finds only observation\.image"):
        adapter.prepare()


def test_the_only_camera_of_tdmpc_is_found(checkpoint: Callable[[str], Weights]) -> None:
    """Regression: `--check` said that sensors_required does not name the camera that it names, and
    the runner's name of it was not found."""
    import numpy as np

    weights = checkpoint("tdmpc")
    text = (
        manifest_text("tdmpc")
        + f"sensors_required: [{{modality: rgb, vla_feature_key: {ONLY_CAMERA}}}]\n"
    )
    adapters = [
        make_adapter(parse_manifest(text.replace("image}", f"{more}}}")), weights)
        for more in ("image", "images.top")
    ]
    found = []
    for adapter in adapters:
        assert isinstance(adapter, PolicyAdapter)
        adapter.prepare()
        adapter.load("cpu")
        adapter.place("cpu")
        found.append(adapter.misfits())
    told = "the checkpoint reads observation.image, sensors_required names observation.images.top"
    assert found == [[], [told]]
    (step,) = observations(1)
    by_the_runner = {STATE: step[STATE], "observation.images.image": step[ONLY_CAMERA]}
    answers = []
    for observation in (step, by_the_runner):
        adapters[0].run(EndpointCall(endpoint="reset"))
        import torch

        torch.manual_seed(SEED)
        answers.append(ask(adapters[0], observation))
    np.testing.assert_array_equal(*answers)


def test_the_manifests_processors_are_used(
    checkpoint: Callable[[str], Weights], tmp_path: Path
) -> None:
    """Regression: the files beside the weights were read, whatever `processors` named."""
    from safetensors.torch import load_file, save_file

    models = tmp_path / "models"
    shutil.copytree(checkpoint("tdmpc").source, models / "x")
    models.joinpath("other").mkdir()
    for file in (models / "x").glob("policy_*"):
        shutil.move(file, models / "other" / file.name.replace(".json", "_v2.json"))
    numbers = models / "other" / "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
    changed = {
        key: value + 100 if key.startswith("action.m") else value
        for key, value in load_file(numbers).items()
    }
    save_file(changed, numbers)
    rskill = tmp_path / "rskill.yaml"

    def write(before: str, after: str) -> None:
        files = f"{{preprocessor_uri: local://{before}, postprocessor_uri: local://{after}}}"
        rskill.write_text(manifest_text("tdmpc", more=f"processors: {files}\n"))

    before, after = "models/other/policy_preprocessor_v2.json", "policy_postprocessor_v2.json"
    write(before, f"models/other/{after}")
    manifest, weights = read_model(rskill, tmp_path)
    adapter = make_adapter(manifest, weights)
    adapter.prepare()
    adapter.load("cpu")
    shutil.move(models / "other", models / "away")  # a residency reads no file
    adapter.place("cpu")
    shutil.move(models / "away", models / "other")
    assert ask(adapter, observations(1)[0]).mean() > 90
    write(before, f"models/other/{after}.bak.json")
    with pytest.raises(ConfigError, match=r"no file .*\.bak\.json"):
        read_model(rskill, tmp_path)
    shutil.copy(models / "other" / after, models / "x" / after)
    write(before, f"models/x/{after}")
    with pytest.raises(ConfigError, match=r"lead to .*other and .*x"):
        read_model(rskill, tmp_path)


def test_a_pinned_revision_is_what_is_loaded(
    checkpoint: Callable[[str], Weights], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: pi0's loader drops the revision, and read the newest weights of the hub."""
    folder = checkpoint("pi05").source
    asked: list[tuple[str, str]] = []

    def snapshot_download(source: str, *, revision: str, **_: Any) -> str:
        asked.append((source, revision))
        return folder

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    adapter = load_policy("pi05", Weights("field/pi05", "0f1e2d"))
    assert asked == [("field/pi05", "0f1e2d")]
    assert ask(adapter, observations(1)[0]).shape == (3, DIM)
