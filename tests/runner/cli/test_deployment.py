"""`vram-runner deploy` before anything is opened: every mistake by line and field, licenses, what
fits the robot, the dry run.
"""

import importlib.util
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.paths import ROOT
from vram_arbiter.runner.__main__ import main, parse
from vram_arbiter.runner.cli.deployment import make_parts, read_deployment
from vram_arbiter.runner.cli.servers import remote_sidecars
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.runtime.folders import LockFile

pytestmark = pytest.mark.heavy  # the SO-101's kinematics

SERVICE = ROOT / "tests/schemas/manifest/samples/ros_service.yaml"
NAVIGATE = ROOT / "configs/rskills/so101-navigate/rskill.yaml"
GRAB = ROOT / "configs/rskills/so101-grab/rskill.yaml"
TWIN_FILE = ROOT / "configs/robots/so101-twin.yaml"
TWIN = "robot_id: bench\nhal: {adapter: so101_kinematic}\n"
CAMERAS = "sensors:\n" + "".join(
    f"  - {{sensor_id: {name}, backend_params: {{device: 0}}}}\n" for name in ("front", "wrist")
)
GRAB_TASK = "task: {id: grab, instruction: grab it}\nvla: {id: vram-arbiter/so101-grab}\n"

DryRun = Callable[..., tuple[int, str, str]]


def test_the_shipped_twin_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["deploy", "--config", str(TWIN_FILE), "--dry-run"]) == 0
    assert "safety    workspace_box_min_xyz" in capsys.readouterr().out


@pytest.fixture
def dry_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> DryRun:
    """Exit code, stdout and stderr of a dry run of this text; fails when it leaves anything
    behind.
    """
    runtime = tmp_path / "runtime"
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(runtime))

    def run(text: str, *flags: str, skills: Path = NAVIGATE) -> tuple[int, str, str]:
        file = tmp_path / "robot.yaml"
        file.write_text(text, encoding="utf-8")
        code = main(["deploy", "--config", str(file), "--dry-run", "--skills", str(skills), *flags])
        assert not runtime.exists()  # no socket, no lock
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def manifest_in(tmp_path: Path, text: str) -> Path:
    """A folder with one skill."""
    folder = tmp_path / "skills"
    folder.mkdir()
    (folder / "rskill.yaml").write_text(text, encoding="utf-8")
    return folder


def licensed(tmp_path: Path, licence: str) -> Path:
    text = re.sub(r'license: "[^"]+"', f'license: "{licence}"', GRAB.read_text(encoding="utf-8"))
    return manifest_in(tmp_path, text)


def test_a_new_file_can_be_tried_dry_beside_the_running_robot(
    capsys: pytest.CaptureFixture[str], short_folder: Path
) -> None:
    """The dry run was refused exactly where an operator needs it: for the sockets of the runner
    that the file is to replace."""
    socket = short_folder / "runner.sock"
    taken = LockFile(Path(f"{socket}.lock"), f"ipc://{socket}", "a server")
    words = ["deploy", "--config", str(TWIN_FILE), "--endpoint", f"ipc://{socket}"]
    taken.acquire()
    try:
        assert main([*words, "--dry-run"]) == 0
        assert f"TAKEN     a server (pid {os.getpid()}) already uses" in capsys.readouterr().out
        assert main(words) == 1
        assert "stop it first" in capsys.readouterr().err
    finally:
        taken.release()
    assert main([*words[:-1], "ipc://relative", "--dry-run"]) == 2, "this one never serves"


def test_the_dry_run_says_what_would_run_and_opens_nothing(dry_run: DryRun) -> None:
    text = TWIN + (
        "rate_hz: 50\ndeadline_overrun_policy: drop\nmax_ticks: 900\nthumbnail_hz: 5\n"
        "safety: {max_joint_speed_factor: 0.5, deadman_required: true}\n"
    )
    code, out, err = dry_run(text)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert "none given" not in out
    assert "safety    none given" in dry_run(TWIN)[1]
    assert lines[0] == "robot     bench: so101 by so101_kinematic, simulated"
    assert sum(line.startswith("joint ") for line in lines) == 6
    assert "rate      50 Hz; late actions: drop" in lines
    assert "end       after 900 ticks" in lines
    assert any(line.startswith("goals ") and "runner.sock" in line for line in lines)
    assert "NOT KEPT  safety.deadman_required" in lines
    assert any(line.startswith("unused    thumbnail_hz") for line in lines)
    assert "body      so101_follower; has_vision False, has_gripper True" in lines
    assert (
        "skill     vram-arbiter/so101-navigate is not offered: it is made for mobile_base; this"
        " robot is so101_follower" in lines
    )
    assert lines[-1] == "dry run: nothing was opened"


def test_the_mark_of_a_stop_that_nobody_looked_at_refuses_the_start_for_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path))
    (tmp_path / "robot-bench.estop").write_text("smoke\n")
    file = tmp_path / "robot.yaml"
    file.write_text(TWIN)
    argv = ["deploy", "--config", str(file), "--skills", str(NAVIGATE), "--no-arbiter"]
    assert main(argv) == 2  # systemd's RestartPreventExitStatus
    assert "smoke" in capsys.readouterr().err


def test_what_a_skill_asks_for_and_the_gate_does_not_keep_is_shown_before_the_robot_moves(
    dry_run: DryRun, tmp_path: Path
) -> None:
    """Regression: only the deployment file's own block was searched for limits that cannot be
    kept.
    """
    text = (
        GRAB.read_text(encoding="utf-8")
        + "envelope: {human_in_loop_required: [grasp], max_force_n: 5}\n"
    )
    _, out, err = dry_run(TWIN + CAMERAS, skills=manifest_in(tmp_path, text))
    assert err == ""
    said = [line for line in out.splitlines() if line.startswith("NOT KEPT")]
    assert any("human_in_loop_required" in line and "so101-grab" in line for line in said)
    assert any("max_force_n (this robot does not tell efforts)" in line for line in said)


def test_each_misfit_of_the_tasks_skill_is_a_line_of_its_own(
    dry_run: DryRun, tmp_path: Path
) -> None:
    """What the robot cannot do is known before anything is opened, for `--check` as well."""
    slots = (
        "action_contract:\n  dim: 6\n  slots:\n"
        "    - {range: [0, 2], control_mode: body_twist, frame: map}\n"
        "    - {range: [3, 5], control_mode: joint_torque}"
    )
    manifest = GRAB.read_text(encoding="utf-8").replace("action_contract:\n  dim: 6", slots)
    folder = manifest_in(tmp_path, manifest)
    code, out, err = dry_run(TWIN + CAMERAS + GRAB_TASK, "--check", skills=folder)
    assert (code, out) == (2, "")
    said = [line for line in err.splitlines() if "action_contract" in line]
    assert len(said) == 2, err
    assert "slots[0].control_mode: so101 has no base to drive" in said[0]
    assert "slots[1].range: covers 3 values for 6 joints" in said[1]


def test_a_sidecar_of_a_server_needs_its_tunnel(dry_run: DryRun) -> None:
    """What `--check` passes can run: without a tunnel that is up nothing would answer."""
    text = TWIN + CAMERAS + "sidecars: {grab: %s}\n"
    code, _, err = dry_run(text % "ssh://arm1@box/grab", skills=GRAB)
    assert code == 1, "a retry may succeed"
    assert "no tunnel to arm1@box forwards grab" in err
    assert "vramctl remote up arm1@box grab" in err
    for wrong in ("ipc:///run/grab.sock", "ssh://box", "ssh://-o/grab"):
        code, _, err = dry_run(text % wrong, skills=GRAB)
        assert (code, "sidecars.grab" in err) == (2, True), err
    code, _, err = dry_run(TWIN + "sidecars: {grb: ssh://box/grab}\n", skills=GRAB)
    assert (code, "robot.yaml:3: sidecars.grb: no such policy" in err) == (2, True), err


def test_a_sidecar_of_a_server_is_used_at_its_arbiter(tmp_path: Path) -> None:
    """The robot's own arbiter does not know that lease."""
    folder = tmp_path / "remote/box"
    folder.mkdir(parents=True)
    (tmp_path / "robot.yaml").write_text(TWIN + "sidecars: {grab: ssh://box/grab}\n")
    file = read_deployment(tmp_path / "robot.yaml")
    with socket.socket(socket.AF_UNIX) as arbiter, socket.socket(socket.AF_UNIX) as grab:
        for listener, name in ((arbiter, "arbiter"), (grab, "grab")):
            listener.bind(str(folder / f"{name}.sock"))
            listener.listen()
        environ = {"VRAM_ARBITER_RUNTIME": str(tmp_path)}
        remote = remote_sidecars(file, [load_manifest(GRAB)], environ)
    ends = (f"ipc://{folder}/grab.sock", f"ipc://{folder}/arbiter.sock")
    assert remote == {"vram-arbiter/so101-grab": ends}


def test_a_policys_vectors_are_told_where_it_fits(dry_run: DryRun) -> None:
    code, out, err = dry_run(TWIN + CAMERAS, skills=GRAB)
    assert (code, err) == (0, "")
    assert "contract  vram-arbiter/so101-grab: 6 actions from a state of 6" in out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("robot_id: bench\nhal: {adaptor: x}\n",
         r"robot\.yaml:2: hal\.adaptor: unknown key; did you mean adapter"),
        ("robot_id: bench\nhal:\n  adapter: so100\n",
         r"robot\.yaml:3: hal\.adapter: unknown adapter 'so100'"),
        ("robot_id: bench\nhal:\n  adapter: so101_kinematic\n  params:\n"
         "    start_pose_rad: {elbow: 1}\n",
         r"robot\.yaml:5: hal\.params\.start_pose_rad\.elbow: no such joint"),
        (TWIN + "safety:\n  max_joint_speed_factor: -1\n",
         r"robot\.yaml:4: safety\.max_joint_speed_factor: must be above 0"),
        (TWIN + "save_dir: /\n", r"robot\.yaml:3: save_dir: / is not empty, and no dataset"),
        (TWIN + "save_dir: /tmp/none\nrate_hz: 12.5\n",
         r"robot\.yaml:3: save_dir: a recording needs a whole number of ticks a second, not 12\.5"),
        (TWIN + "sensors:\n  - {sensor_id: joint_state, backend_params: {device: 0}}\n",
         r"robot\.yaml:4: sensors\[0\]\.sensor_id: .* joint_state"),
        (TWIN + "rate_hz: 0\n", r"robot\.yaml:3: rate_hz: "),
        (TWIN + "task: {id: t}\nvla:\n  id: no/such\n",
         r"robot\.yaml:5: vla\.id: no skill 'no/such' is installed"),
        (TWIN + "task: {id: t}\nvla:\n  id: vram-arbiter/so101-navigate\n",
         r"robot\.yaml:5: vla\.id: vram-arbiter/so101-navigate is not offered here: it is made "
         r"for mobile_base; this robot is so101_follower"),
        (TWIN + "embodiment_tags: [mobile_base]\ntask: {id: t}\n"
         "vla:\n  id: vram-arbiter/so101-navigate\n",
         r"robot\.yaml:6: vla\.id: .* is not offered here: this runner stands in for "
         r"control_msgs/FollowJointTrajectory, not for nav2_msgs/NavigateToPose"),
        (TWIN + "embodiment_tags: [any]\n",
         r"robot\.yaml:1: .*'any' is what a skill may be made for, not what a robot is"),
        (TWIN + "embodiment_tags: [5]\n", r"robot\.yaml:3: embodiment_tags\[0\]: "),
    ],
)  # fmt: skip
def test_mistakes_are_named_by_line_and_field(dry_run: DryRun, text: str, said: str) -> None:
    code, out, err = dry_run(text)
    assert (code, out) == (2, "")
    assert re.search(said, err), err


def test_mistakes_of_all_sections_are_named_at_once(dry_run: DryRun) -> None:
    text = (
        "robot_id: bench\n"
        "hal:\n"
        "  adapter: so101_kinematic\n"
        "  transport: {port: /dev/ttyACM0}\n"
        "sensors:\n"
        "  - sensor_id: front\n"
        "    backend_params:\n"
        "      devise: 0\n"
        "  - {sensor_id: wrist, backend: holoscan}\n"
    )
    code, _, err = dry_run(text)
    assert code == 2
    assert re.search(r"robot\.yaml:4: hal\.transport\.port: ", err), err
    assert re.search(r"robot\.yaml:8: sensors\[0\]\.backend_params\.devise: unknown key", err), err
    assert re.search(r"robot\.yaml:9: sensors\[1\]\.backend: ", err), err


def test_a_missing_package_is_told_by_line_with_what_to_install(
    dry_run: DryRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "cv2" else find(name)
    )
    code, _, err = dry_run(f"{TWIN}sensors:\n  - {{sensor_id: a, backend_params: {{device: 0}}}}\n")
    assert code == 2
    said = r"robot\.yaml:\d: sensors\[0\]: opencv_thread needs cv2.*vram-arbiter\[runner\]"
    assert re.search(said, err), err


def test_a_file_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["deploy", "--config", "none.yaml", "--dry-run"]) == 2
    assert "none.yaml" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        parse(["deploy"])


def test_a_task_needs_the_cameras_that_its_skill_looks_at(dry_run: DryRun) -> None:
    code, _, err = dry_run(
        TWIN + "sensors:\n  - {sensor_id: front, backend_params: {device: 0}}\n" + GRAB_TASK,
        skills=GRAB,
    )
    assert code == 2
    assert re.search(
        r"robot\.yaml:3: sensors: vram-arbiter/so101-grab needs the cameras wrist; there is front",
        err,
    ), err


def test_a_task_that_fits_passes(dry_run: DryRun) -> None:
    code, out, err = dry_run(TWIN + CAMERAS + GRAB_TASK, skills=GRAB)
    assert code == 0, err
    assert "task      grab: vram-arbiter/so101-grab 'grab it'" in out
    assert re.search(r"sidecar +of vram-arbiter/so101-grab at ipc://.*/grab\.sock", out), out
    assert "camera    front by opencv_thread, at most 100 ms old" in out


def test_the_fields_own_files_are_read_as_the_field_means_them(dry_run: DryRun) -> None:
    """`vla.id` is the policy's family there and `vla.weights_uri` the skill, `quantization` a
    block, 0 turns pictures off, and tags are the fleet's own."""
    text = TWIN + CAMERAS + "thumbnail_hz: 0\nembodiment_tags: [so101_follower, our_lab_3]\n"
    task = (
        "task: {id: grab}\nvla:\n  id: act\n  weights_uri: {uri}\n  quantization: {dtype: {dtype}, "
        "extra: {}}\n"
    )
    vla = task.replace("{dtype}", "fp32")
    for uri in ("rskills/so101-grab", "rskills/so101-grab/", "vram-arbiter/so101-grab"):
        code, out, err = dry_run(text + vla.replace("{uri}", uri), skills=GRAB)
        assert (code, err) == (0, "")
        assert "task      grab: vram-arbiter/so101-grab ''" in out
        assert "unused    embodiment_tags: 'our_lab_3', which no manifest can name" in out
    wrong = {
        vla.replace("id: act", "id: smolvla").replace(
            "{uri}", "rskills/so101-grab"
        ): "vla.id: smolvla is not what",
        task.replace("{dtype}", "int4").replace(
            "{uri}", "rskills/so101-grab"
        ): "vla.quantization: dtype int4 is not",
        vla.replace("{uri}", "rskills/none"): "vla.id: no skill 'act' is installed",
        vla.replace("{uri}", "rskills/so101-grab").replace(
            "dtype:", "dtyp:"
        ): "vla.quantization.dtyp: unknown key; did you mean dtype?",
    }
    for block, told in wrong.items():
        code, _, err = dry_run(text + block, skills=GRAB)
        assert (code, told in err) == (2, True), err


@pytest.mark.parametrize(
    "field", ["weights_uri: 'hf://other/weights'", "runtime: onnx", "quantization: int4"]
)
def test_the_file_cannot_ask_for_other_weights_than_are_installed(
    dry_run: DryRun, field: str
) -> None:
    task = f"task: {{id: grab}}\nvla:\n  id: vram-arbiter/so101-grab\n  {field}\n"
    code, _, err = dry_run(TWIN + CAMERAS + task, skills=GRAB)
    assert code == 2
    assert re.search(rf"robot\.yaml:9: vla\.{field.partition(':')[0]}: .* is not what", err), err


def test_a_licence_that_forbids_commercial_use_stops_the_task_without_a_flag(
    dry_run: DryRun, tmp_path: Path
) -> None:
    text, skills = TWIN + CAMERAS + GRAB_TASK, licensed(tmp_path, "nvidia_non_commercial")
    code, _, err = dry_run(text, skills=skills)
    assert code == 2
    told = r"robot\.yaml:7: vla\.id: .*nvidia_non_commercial.*--allow-noncommercial"
    assert re.search(told, err), err
    code, out, _ = dry_run(text, "--allow-noncommercial", skills=skills)
    assert code == 0
    assert "so101-grab 0.1.0 (nvidia_non_commercial)" in out
    for licence in ("proprietary", "unknown", "permissive_research"):
        other = load_manifest(GRAB).model_copy(update={"license": licence})
        assert not other.is_commercial_use_allowed


def test_serving_goals_offers_only_what_is_licensed_and_fits(
    dry_run: DryRun, tmp_path: Path
) -> None:
    code, out, _ = dry_run(TWIN, skills=licensed(tmp_path, "unknown"))
    assert code == 0
    assert re.search(
        r"skill +vram-arbiter/so101-grab is not offered: its license \(unknown\)", out
    ), out
    code, out, _ = dry_run(TWIN, skills=GRAB)
    assert code == 0
    assert re.search(
        r"skill +vram-arbiter/so101-grab is not offered: .*needs the cameras front, wrist; there "
        r"is none",
        out,
    ), out


def test_a_skill_for_another_robot_or_beyond_this_one_is_refused(
    dry_run: DryRun, tmp_path: Path
) -> None:
    """By tag, and by the value of a capability; the file may say more of the robot than its adapter
    does.
    """
    needs = "capabilities_required: {can_lift_kg: 0.5, has_vision: true}\nkind: "
    folder = manifest_in(tmp_path, GRAB.read_text(encoding="utf-8").replace("kind: ", needs, 1))
    text = TWIN + CAMERAS + GRAB_TASK
    code, _, err = dry_run(text, skills=folder)
    assert code == 2
    assert "robot.yaml:7: vla.id: " in err
    assert "it needs can_lift_kg of at least 0.5; this robot has none" in err
    weak, strong = (f"capabilities: {{can_lift_kg: {kg}}}\n" for kg in (0.2, 0.5))
    assert "this robot has 0.2" in dry_run(text + weak, skills=folder)[2]
    code, out, err = dry_run(text + strong, skills=folder)
    assert code == 0, err
    assert "has_vision True, has_gripper True, can_lift_kg 0.5" in out
    code, _, err = dry_run(text + strong + "embodiment_tags: [ur5e]\n", skills=folder)
    assert code == 2
    assert "it is made for so101_follower; this robot is ur5e" in err


VALUES = [
    "[]",
    "{}",
    "{a: 1}",
    "null",
    "true",
    "-1",
    "0",
    ".nan",
    ".inf",
    "1e400",
    "''",
    "x",
    "[null]",
    "2020-01-01",
    "'\\0'",
    "[x, x]",
]
PLACES = [
    "hal: {adapter: %s}",
    "hal: {adapter: so101_mujoco, transport: %s}",
    "hal: {adapter: so101_kinematic, params: {x: %s}}",
    "hal: {adapter: 'lerobot:so101_follower', transport: {port: %s, id: x}}",
    "sensors: [{sensor_id: a, backend_params: %s}]",
    "sensors: [{sensor_id: a, backend_params: {device: %s, width: 640}}]",
    "sensors: [{sensor_id: a, backend_params: {device: 0, fps: %s}}]",
    "sensors: [{sensor_id: a, backend: gstreamer, backend_params: {pipeline: %s}}]",
    "sensors: [{sensor_id: a, backend: %s}]",
    "sensors: [{sensor_id: a, backend: ros2_image, backend_params: {topic: %s}}]",
    "safety: {max_joint_speed_factor: %s}",
    "safety: {workspace_box_min_xyz: %s, workspace_box_max_xyz: [1, 1, 1]}",
    "save_dir: %s",
    "rate_hz: %s",
    "capabilities: {a: %s}",
    "vla: {id: act, weights_uri: %s, quantization: {dtype: %s}}\ntask: {id: t}",
    "task: {id: %s, max_steps: %s}\nvla: {id: x}",
]


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(place=st.sampled_from(PLACES), value=st.sampled_from(VALUES))
def test_any_value_in_a_deployment_is_taken_or_found_fault_with(
    tmp_path: Path, place: str, value: str
) -> None:
    """Adapters, cameras and the gate check what the file's own model leaves to them."""
    text = place.replace("%s", value)
    head = "robot_id: bench\n" if text.startswith("hal") else TWIN
    file = tmp_path / "robot.yaml"
    file.write_text(f"{head}{text}\n", encoding="utf-8")
    said = "robot.yaml: "
    try:
        make_parts(read_deployment(file), SystemClock())
    except ConfigError as error:
        said = error.message
    assert re.match(r"robot\.yaml(:\d+)*: ", said), said


def test_a_continuous_detector_is_checked_against_the_installed_ones(dry_run: DryRun) -> None:
    skills = ROOT / "configs/rskills/so101-detector"

    def text(detector: str) -> str:
        return f"{TWIN}{CAMERAS}detectors:\n  - {{{detector}, sensor_id: front}}\n"

    watched = text("id: vram-arbiter/so101-detector, mode: continuous, queries: [red cube]")
    code, out, err = dry_run(watched, skills=skills)
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if line.startswith("detector ")]
    assert "detector.sock looks at front, at most 2 times a second; at most 1000 ms old" in line
    given = ("--sidecar", "vram-arbiter/so101-detector=ipc:///d.sock")
    assert "so101-detector at ipc:///d.sock looks" in dry_run(watched, *given, skills=skills)[1]
    assert "detectors" not in dry_run(TWIN)[1]  # off unless the file asks for it
    for detector, expected in {
        "id: vram-arbiter/so101-detector": "robot.yaml:7: detectors[0].mode:"
        " vram-arbiter/so101-detector is on_demand by its manifest: write `mode: continuous`",
        "id: a/b": "detectors[0].id: no such detector is installed: a/b; there is"
        " vram-arbiter/so101-detector",
    }.items():
        code, _, err = dry_run(text(detector), skills=skills)
        assert code == 2
        assert expected in err
    twice = watched + "  - {id: vram-arbiter/so101-detector, sensor_id: front}\n"
    assert "one detector a camera; given twice: front" in dry_run(twice, skills=skills)[2]
    blind = f"{TWIN}{CAMERAS}detectors:\n  - {{id: a/b, sensor_id: rear}}\n"
    assert "detectors look at cameras that are not there: rear" in dry_run(blind)[2]


def test_a_topic_that_stops_the_robot_is_named_and_not_told_as_unkept(dry_run: DryRun) -> None:
    """With a skill for the robot's body the topic was named as listened to and as not kept."""
    pytest.importorskip("cyclonedds")
    asked = TWIN + "safety: {e_stop_topic: /cell/e_stop, deadman_required: true}\n"
    out = dry_run(asked, skills=NAVIGATE.parents[1] / "so101-move")[1]
    assert "skill     vram-arbiter/so101-move 0.1.0 (apache-2.0)" in out.splitlines()
    assert "estop     also by /cell/e_stop (std_msgs/Bool)" in out.splitlines()
    assert "NOT KEPT  safety.deadman_required" in out
    assert "NOT KEPT  safety.e_stop_topic" not in out


def test_an_action_that_a_ros_server_executes_is_offered_only_if_the_file_says_so(
    dry_run: DryRun,
) -> None:
    pytest.importorskip("cyclonedds")
    driving = TWIN + "embodiment_tags: [so101_follower, mobile_base]\n"
    here = "so101-navigate is not offered: this runner stands in for control_msgs/FollowJoint"
    assert here in dry_run(driving)[1]
    served = driving + "ros_actions: [nav2_msgs/NavigateToPose]\n"
    code, out, _ = dry_run(served)
    assert code == 0
    assert "by ROS 2 servers, past this runner's gate and motors: nav2_msgs/NavigateToPose" in out
    assert here not in out
    assert "not offered" not in out


def test_a_service_is_called_only_if_the_file_says_so_and_its_type_is_known(
    dry_run: DryRun, tmp_path: Path
) -> None:
    pytest.importorskip("cyclonedds")
    text = SERVICE.read_text(encoding="utf-8")
    text = text.replace("moveit_msgs", "std_srvs").replace("MoveGroup", "Trigger")
    skill = tmp_path / "rskill.yaml"
    skill.write_text(text, encoding="utf-8")
    asked = TWIN + "ros_services: [std_srvs/Trigger]\n"
    code, out, _ = dry_run(asked, skills=skill)
    assert code == 0
    assert "by ROS 2 servers, past this runner's gate and motors: std_srvs/Trigger" in out
    assert "skill     acme/rskill-aim 0.1.0 (bsd)" in out.splitlines()
    here = "acme/rskill-aim is not offered: this runner stands in for none, not for std_srvs/Trig"
    assert here in dry_run(TWIN, skills=skill)[1]
    skill.write_text(text.replace("Trigger", "Open"), encoding="utf-8")
    unknown = dry_run(TWIN + "ros_services: [std_srvs/Open]\n", skills=skill)[1]
    assert "is not offered: std_srvs/Open needs a definition in the manifest's" in unknown
