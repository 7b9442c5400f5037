"""What a sidecar is told: flags, manifest, footprint file, environment."""

from pathlib import Path

import pytest

from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import ConfigError, NoGpu
from vram_arbiter.schemas.manifest import parse_manifest
from vram_arbiter.sidecars.__main__ import main, parser, settings_from
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.device.capacity import leased_gpu
from vram_arbiter.sidecars.settings import (
    DECLARED,
    FootprintEntry,
    footprint_for,
    parse_footprint,
    read_footprints,
)
from vram_arbiter.sidecars.weights import Weights

HEAD = (
    "name: test/model\nversion: 1.2.3\nembodiment_tags: [any]\nchunk_size: 1\n"
    "description: d\nlatency_budget: {per_chunk_ms: 1}\n"
)
DETECTOR = (
    HEAD + "kind: detector\nweights_uri: hf://a/b@rev\nactions: [detect]\ndetector: {labels: [x]}\n"
)
SHIPPED = Path(__file__).parents[2] / "configs/models/footprints.yaml"


@pytest.fixture
def rskill(tmp_path):
    path = tmp_path / "rskill.yaml"
    path.write_text(DETECTOR)
    return path


def settings(*flags):
    return settings_from(parser().parse_args([str(flag) for flag in flags]))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("5.3GB,5GB,450MiB,6GB", (5_300_000_000, 5_000_000_000, 450 * MIB, 6 * 10**9)),
        ("5.3GB,5GB,450MiB", (5_300_000_000, 5_000_000_000, 450 * MIB, 0)),
        ("2GB,1GB", (2 * 10**9, 10**9, 450 * MIB, 0)),
        ("1GB", (10**9, 10**9, 450 * MIB, 0)),
    ],
)
def test_the_footprint_flag(text, expected):
    entry = parse_footprint(text)
    assert (entry.load_peak, entry.steady, entry.residue, entry.inference_peak) == expected


@pytest.mark.parametrize(
    "text",
    [
        "much",
        "1GB,2GB",
        "1GB,1GB,1GB,1GB,1GB",
        "1GB,1GB,2GB",
        "2GB,2GB,1GB,1GB",  # an inference peak below the resident weights
        "",
    ],
)
def test_a_footprint_that_makes_no_sense(text):
    with pytest.raises(ConfigError, match="write PEAK,STEADY,RESIDUE"):
        parse_footprint(text)


def test_the_shipped_footprints_are_the_measured_ones():
    entries = read_footprints(SHIPPED)
    peaks = {name: (entry.load_peak, entry.stands_for) for name, entry in entries.items()}
    assert peaks["vram-arbiter/so101-detector"] == (
        5_300_000_000,
        "OpenRAL/rskill-locateanything-3b-nf4",
    )
    assert peaks["vram-arbiter/so101-scene-vlm"][0] == 3_300_000_000
    assert peaks["vram-arbiter/so101-grab"][0] == 4_300_000_000
    assert all(entry.source and entry.residue == 450 * MIB for entry in entries.values())


def test_a_footprint_is_found_by_model_and_number_format():
    """Regression: a field manifest of a model whose bytes are on file was charged the 2.5 GB that
    it declares, where 3.3 GB are resident: entries were looked up by the manifest's name alone."""
    entries = read_footprints(SHIPPED)
    field = parse_manifest(
        HEAD.replace("test/model", "OpenRAL/rskill-qwen35-4b-nf4")
        + "kind: vlm\nrole: s2\nactions: [query]\nquantization: {dtype: int4}\n"
        "min_vram_gb: {int4: 2.5}\nweights_uri: hf://OpenRAL/rskill-qwen35-4b-nf4\n"
        "source_repo: hf://Qwen/Qwen3.5-4B@851bf6e8\n"
    )
    assert footprint_for(field, entries).steady == 3_300_000_000

    manifest = parse_manifest(
        DETECTOR.replace("name: test/model", "name: test/model\nsource_repo: hf://s/t@1")
        + "min_vram_gb: {fp32: 9}\n"
    )
    keys = ["test/model/fp32", "a/b/fp32", "s/t/fp32", "test/model"]  # the nearest first
    others = ["test/model/int4", "a/b/fp16", "s/t", "a/b"]
    found = {
        key: FootprintEntry(load_peak=number, steady=number, residue=number)
        for number, key in enumerate(keys + others, 1)
    }
    for number in range(1, len(keys) + 1):
        assert footprint_for(manifest, found).steady == number
        del found[keys[number - 1]]
    assert footprint_for(manifest, found).source == DECLARED


def test_the_lease_covers_the_inference_peak(rskill):
    """Two models that are charged their weights alone fit beside each other until both answer."""
    flags = ("--name", "d", "--rskill", rskill, "--device", "none", "--footprint")
    found = settings(*flags, "3GB,2GB,450MiB,4GB")
    footprint = found.lease_spec().footprint
    assert (footprint.load_peak_bytes, footprint.steady_bytes) == (4 * 10**9, 4 * 10**9)
    assert found.footprint.steady_bytes == 2 * 10**9, "what a simulated GPU is filled with"
    assert [found.steady_charge(size) for size in (10**9, 5 * 10**9)] == [4 * 10**9, 5 * 10**9]
    footprint = settings(*flags, "3GB,2GB").lease_spec().footprint
    assert (footprint.load_peak_bytes, footprint.steady_bytes) == (3 * 10**9, 2 * 10**9)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a/b: {load_peak: 1GB, steady: 1GB, residu: 1}", "footprints.yaml:1: a/b.residu"),
        ("a/b:\n  load_peak: much\n  steady: 1GB\n", "footprints.yaml:2: a/b.load_peak"),
        ("a/b/fp31: {load_peak: 1GB, steady: 1GB}", "footprints.yaml:1: a/b/fp31: names no model"),
        ("- 1", "must be a mapping"),
        ("a/b: [", "not valid YAML"),
    ],
)
def test_a_wrong_entry_is_named_with_its_line(tmp_path, text, told):
    path = tmp_path / "footprints.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_footprints(path)
    assert told in str(caught.value)


def test_without_an_entry_the_manifest_counts_and_without_both_nobody_guesses():
    declared = parse_manifest(DETECTOR + "min_vram_gb: {fp32: 2.5}\n")
    assert footprint_for(declared, {}).on_wire().load_peak_bytes == 2_500_000_000
    own = FootprintEntry(load_peak=5, steady=4, residue=3)
    assert footprint_for(declared, {"test/model": own}) is own
    with pytest.raises(ConfigError, match="no footprint is known"):
        footprint_for(parse_manifest(DETECTOR), {})


def test_flags_and_environment_become_settings(rskill, tmp_path, monkeypatch):
    make_gpu(tmp_path / "gpu", 8 * 2**30)
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", "/run/x")
    monkeypatch.setenv("VRAM_FAKE_GPU", str(tmp_path / "gpu"))
    model = ("--rskill", rskill, "--footprint", "2GB")
    found = settings("--name", "detector", *model, "--priority", "70", "--pinned")
    assert found.endpoint == "ipc:///run/x/detector.sock"
    assert found.arbiter == "ipc:///run/x/arbiter.sock"
    assert found.device == f"fake:{tmp_path / 'gpu'}"
    assert found.weights == Weights("a/b", "rev")
    spec = found.lease_spec()
    assert (spec.consumer, spec.model_id, spec.revision) == ("detector", "test/model", "rev")
    assert (spec.priority, spec.evictable, spec.footprint.load_peak_bytes) == (70, False, 2 * 10**9)
    own = FakeProbe([tmp_path / "gpu"]).gpus()[0].id
    assert (found.gpu, leased_gpu(found.device)) == (None, own), "charged and leased is one GPU"
    alone = settings("--name", "d", *model, "--no-arbiter", "--device", "cuda:1")
    assert (alone.arbiter, alone.device) == (None, "cuda:1")
    with pytest.raises(ConfigError, match="--device gpu"):
        settings("--name", "d", *model, "--device", "gpu")
    with pytest.raises(ConfigError, match="any user of the machine"):
        settings("--name", "d", *model, "--endpoint", "tcp://127.0.0.1:5757")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (DETECTOR.replace("{labels: [x]}", "{labels: [x], engine: rtdetr_onnx}"), "engine"),
        (DETECTOR + "runtime: gguf\n", "runtime 'gguf'"),
        (
            DETECTOR.replace("{labels: [x]}", "{labels: [x], engine: zeroshot_hf}")
            + "runtime: onnx\n",
            "engine zeroshot_hf is not served by onnx",
        ),
        (HEAD + "kind: wam\nweights_uri: hf://a/b\nactions: [grasp]\n", "kind 'wam' is not served"),
        (
            HEAD + "kind: segmenter\nweights_uri: hf://a/b\nactions: [detect]\nsegmenter: {engine: "
            "sam2_hf}\n",
            "kind 'segmenter' is not served",
        ),
    ],
)
def test_what_no_sidecar_serves_is_said(text, told):
    with pytest.raises(ConfigError, match=told):
        make_adapter(parse_manifest(text), Weights("a/b"))


def test_the_gpu_to_lease_is_the_device_that_it_loads_on(tmp_path):
    assert leased_gpu("cuda:1", {}) == "1"
    assert leased_gpu("cuda", {}) == leased_gpu("none", {}) == "any"
    assert leased_gpu("cuda:1", {"CUDA_VISIBLE_DEVICES": "GPU-b"}) == "any", "CUDA counts otherwise"
    with pytest.raises(NoGpu, match="start the arbiter with --gpu fake:8GiB"):
        leased_gpu(f"fake:{tmp_path}", {})


def test_what_only_a_person_can_mend_is_not_started_again(rskill, tmp_path, capsys):
    """systemd starts a sidecar again unless it ended with 2."""
    flags = ["--name", "d", "--rskill", str(rskill), "--footprint", "2GB"]
    for more in ([], ["--check"]):
        assert main([*flags, *more, "--device", "none", "--standby", "--idle-release-s", "5"]) == 2
        assert main([*flags, *more, "--device", "gpu"]) == 2
        assert main([*flags, *more, "--device", "none", "--rskill", str(tmp_path / "none")]) == 2
    rskill.write_text(DETECTOR.replace("labels", "lables"))
    assert main([*flags, "--check", "--device", "none"]) == 2
    assert "lables" in capsys.readouterr().err
    rskill.write_text(DETECTOR)
    with pytest.raises(SystemExit) as caught:
        main([*flags, "--check", "--priority", "101"])
    assert caught.value.code == 2


@pytest.mark.parametrize("name", ["", "../x", "a\nb", "x" * 1000])
def test_a_name_that_nobody_could_use_is_refused_at_once(rskill, capsys, name):
    """Regression: `--name ""` and `--name ../x` served at a path that no client looks at."""
    with pytest.raises(SystemExit) as caught:
        main(["--name", name, "--rskill", str(rskill), "--device", "none", "--check"])
    assert caught.value.code == 2
    assert "argument --name: must be" in capsys.readouterr().err
