"""Bundles keep to their own folders: nobody's files are lost, whatever is in the way."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_opt.bundles import BundleOptions, Origin, export
from hybrid_opt.bundles.bundle import read_manifest, write_bundle
from hybrid_opt.errors import JobError, ResultsError
from hybrid_opt.robust.squeeze import SqueezeSettings
from hybrid_opt.store.files import sha256
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import DRIVER, driven
from tests.hybrid_opt.job.jobs import rack, rack_job, rack_jobs, rack_timing

FILES: dict[str, str | bytes] = {"a.txt": "one", "sub/b.bin": b"two"}


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_bundle_is_replaced_as_a_whole(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "bundle"
    paths = write_bundle(folder, FILES, {"target": "x"})
    assert [path.relative_to(folder).as_posix() for path in paths] == [
        "manifest.json",
        "a.txt",
        "sub/b.bin",
    ]
    assert read_manifest(folder)["files"]["a.txt"] == sha256(b"one")
    write_bundle(folder, {"c.txt": "three"}, {"target": "x"})
    assert set(tree(folder)) == {"manifest.json", "c.txt"}
    assert [path.name for path in folder.parent.iterdir()] == ["bundle"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("notes.txt", "mine", "no file of this bundle"),
        ("a.txt", "edited", "was changed"),
        ("manifest.json", "{}", "in the way"),
        ("manifest.json", "{", "in the way"),
        ("manifest.json", None, "in the way .*was changed"),
    ],
)
def test_foreign_and_edited_files_stay(
    tmp_path: Path, name: str, content: str | None, message: str
) -> None:
    folder = tmp_path / "bundle"
    write_bundle(folder, FILES, {"note": "as written"})
    own = (folder / "manifest.json").read_text().replace("as written", "mine")
    (folder / name).write_text(own if content is None else content)
    before = tree(tmp_path)
    with pytest.raises(ResultsError, match=message):
        write_bundle(folder, FILES, {})
    assert tree(tmp_path) == before


def test_a_file_or_link_in_the_way_stays(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    for name in ("file", "link"):
        with pytest.raises(ResultsError, match="in the way"):
            write_bundle(tmp_path / name, FILES, {})
    with pytest.raises(ResultsError, match="cannot be written"):
        write_bundle(tmp_path / "file" / "bundle", FILES, {})
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_what_cannot_be_written_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    folder = tmp_path / "bundle"
    write_bundle(folder, FILES, {})
    before = tree(tmp_path)
    count = 0

    def fsync(handle: int) -> None:
        nonlocal count
        count += 1
        if count == 2:
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(ResultsError, match=str(folder)):
        write_bundle(folder, {"other.txt": "new"}, {})
    assert tree(tmp_path) == before


def test_an_interrupted_exchange_leaves_the_old_bundle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "bundle"
    write_bundle(folder, FILES, {})
    before = tree(tmp_path)
    rename, count = os.rename, 0

    def second_fails(source: Path, target: Path) -> None:
        nonlocal count
        count += 1
        if count == 2:
            raise OSError(errno.EIO, "input/output error")
        rename(source, target)

    monkeypatch.setattr(os, "rename", second_fails)
    with pytest.raises(ResultsError):
        write_bundle(folder, {"other.txt": "new"}, {})
    assert tree(tmp_path) == before


def test_different_carries_never_touch_one_another(tmp_path: Path) -> None:
    origin = Origin("rack", "nsga2", 3, 12)
    first = export(rack_job(), "csv", tmp_path, origin=origin)
    pressed = rack_jobs().plan(rack_timing(), SqueezeSettings(factor=1.5))
    fast = time_path(rack().timing_model, rack().initial, TimingLimits(force=60.0))
    before = tree(tmp_path)
    folders = {first[0].parent}
    for job in (pressed, rack_jobs().plan(fast)):
        folders.add(export(job, "csv", tmp_path, origin=origin)[0].parent)
    assert len(folders) == 3
    assert all(folder.parent.name.startswith("rack-nsga2-r03-p0012-") for folder in folders)
    assert {name: tree(tmp_path)[name] for name in before} == before
    again = export(rack_job(), "csv", tmp_path, origin=origin)
    assert again == first
    assert {name: tree(tmp_path)[name] for name in before} == before


def test_names_are_names_of_files() -> None:
    for study in ("a/../b", "..", "räck  x", "x" * 500, "\0"):
        name = Origin(study, "nsga2-polished").name(rack_job())
        assert set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
        assert len(name) < 120
    selected = Path("results/rack/selected/mopso-polished/07.json")
    provenance = {"algorithm": "mopso", "replica": 7, "row": 41}
    name = Origin.of_file(selected, b"", provenance).name(rack_job())
    assert name.startswith("rack-mopso-polished-r07-p0041-")
    assert (
        Origin.of_file(Path("my carry.json"), b"", {"replica": "x"})
        .name(rack_job())
        .startswith("my-carry-")
    )


def test_the_manifest_says_what_it_is(tmp_path: Path) -> None:
    paths = export(rack_job(), "csv", tmp_path, origin=Origin("rack", "nsga2", 0, 5))
    document = json.loads(paths[0].read_text())
    assert document["files"]["job.csv"] == sha256(paths[1].read_bytes())
    assert [phase["name"] for phase in document["phases"]] == [p.name for p in rack_job().phases]
    assert all(phase["free_of_collisions"] for phase in document["phases"])
    worst = max(value for phase in document["phases"] for value in phase["limits"].values())
    assert worst <= 1.005
    squeeze = document["squeeze"]
    assert squeeze["factor"] is None
    assert squeeze["force"] == pytest.approx(squeeze["peak_normal_force"][1], rel=1e-9)
    assert sum(squeeze["parts"].values()) == pytest.approx(squeeze["force"], rel=1e-9)
    # The rack's own experiment is the paper's.
    assert rack_job().workcell.task.allocation == "paper"
    assert squeeze["assumes"].endswith("by moments commanded at both wrists")
    assert document["units"]["force"] == "N"
    assert document["how_to_run"]
    assert any("tool_load" in warning for warning in document["warnings"])
    assert not any("acceleration" in warning for warning in document["warnings"])
    rough = rack_jobs().plan(rack_timing(), smoothing=0.0)
    warnings = json.loads(export(rough, "csv", tmp_path)[0].read_text())["warnings"]
    assert any("acceleration" in warning for warning in warnings)
    skew = document["start_skew"]
    assert [each["delay"] for each in skew["cases"]] == [0.001, 0.002, 0.005, 0.01, 0.02]
    assert [each["holds"] for each in skew["cases"]] == [
        each["delay"] <= skew["survived"] for each in skew["cases"]
    ]
    assert skew["required"] is None


def test_the_manifest_says_how_the_job_stops(tmp_path: Path) -> None:
    document = json.loads(export(rack_job(), "ros2-control", tmp_path)[0].read_text())
    machine = document["machine"]
    assert set(machine["states"]) == {"ready", "running", "stopping", "held", "done"}
    assert machine["carried_out_by"].startswith("run_job.py")
    assert machine["stop"]["force_use"] <= 1.0
    assert machine["limits"]["stop_time"] == machine["stop"]["time"]
    assert "'back'" in machine["set_down"]
    step = document["time_step"]
    assert step["interpolation"] == "quintic"
    assert step["share"] <= step["allowed_share"]
    assert step["force"] == pytest.approx(step["stiffness"] / 2.0 * step["along"])


def test_two_controllers_have_to_survive_their_skew(tmp_path: Path) -> None:
    """One clock needs nothing; where each arm plans by itself, 10 ms or what is asked for."""
    job = driven(rack_job())
    stiff = BundleOptions(step=0.1, stiffness=5e4)
    document = json.loads(export(job, "ros2-control", tmp_path, options=stiff)[0].read_text())
    assert document["start_skew"]["required"] == 0.0
    assert document["start_skew"]["survived"] < 0.01
    with pytest.raises(JobError, match="a skew of 10 ms"):
        export(job, "abb-rapid", tmp_path, options=stiff)
    with pytest.raises(JobError, match="a skew of 20 ms"):
        export(job, "csv", tmp_path, options=replace(stiff, skew=0.02))
    reached = replace(stiff, skew=1e-3)
    document = json.loads(export(job, "abb-rapid", tmp_path, options=reached)[0].read_text())
    assert document["start_skew"]["required"] == 1e-3
    with pytest.raises(SettingsError, match="skew"):
        BundleOptions(skew=-1.0)


REFUSED = {
    "franka-ros2": (DRIVER, "does not look like an arm of Franka"),
    "ur-ros2": (DRIVER, "does not look like an arm of UR"),
    "ur-script": (DRIVER, "does not look like an arm of UR"),
    "abb-rapid": (replace(DRIVER, force_control=False), "would not squeeze: positions alone"),
    "abb-egm": (replace(DRIVER, lag=0.0), "compensates the lag of 'left'"),
}


@pytest.mark.parametrize("target", REFUSED)
def test_a_target_says_what_it_lacks(target: str, tmp_path: Path) -> None:
    driver, told = REFUSED[target]
    with pytest.raises(SettingsError, match=told):
        export(driven(rack_job(), driver), target, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_other_arm_is_named_where_it_can_press(tmp_path: Path) -> None:
    job = driven(rack_job(), replace(DRIVER, force_control=False))
    leader, robots = job.squeeze.leader, list(job.workcell.robots)
    with pytest.raises(SettingsError, match="before the study"):
        export(job, "abb-rapid", tmp_path)
    robots[leader] = replace(robots[leader], driver=DRIVER)
    job = replace(job, workcell=replace(job.workcell, robots=(robots[0], robots[1])))
    told = f"let '{robots[leader].name}' press, which has it \\(--leader {2 - leader}\\)"
    with pytest.raises(SettingsError, match=told):
        export(job, "abb-rapid", tmp_path)


def test_joints_have_names_of_their_own(tmp_path: Path) -> None:
    """As drivers name them: by the robot, or by a prefix that is stated."""
    job = driven(rack_job(), replace(DRIVER, prefix="same_"))
    with pytest.raises(SettingsError, match="the prefix 'same_', so that both arms' joints"):
        export(job, "ros2-control", tmp_path)
    first, second = job.workcell.robots
    named = replace(first, driver=replace(DRIVER, prefix="l_"))
    cell = replace(job.workcell, robots=(named, second))
    paths = export(replace(job, workcell=cell), "json", tmp_path)
    robots = json.loads(next(p for p in paths if p.name == "job.json").read_text())["robots"]
    assert [robot["ros_joints"][0] for robot in robots] == ["l_joint_1", "same_joint_1"]


def test_a_driver_has_to_have_an_address(tmp_path: Path) -> None:
    job = driven(rack_job(), replace(DRIVER, address=""))
    with pytest.raises(SettingsError, match=r"ur-ros2 has to know where .* address"):
        export(job, "ur-ros2", tmp_path, options=BundleOptions(any_arm=True))
    hosts = ("10.0.0.1", "arm-2.local")
    paths = export(job, "ur-ros2", tmp_path, options=BundleOptions(any_arm=True, addresses=hosts))
    config = json.loads(next(p for p in paths if p.name == "cell.json").read_text())
    assert tuple(each["arguments"]["robot_ip"] for each in config["launch"]) == hosts
    with pytest.raises(SettingsError, match="no host name or IP address"):
        export(job, "ur-ros2", tmp_path, options=BundleOptions(addresses=("a b", "c")))


def test_a_timing_is_exported_with_its_job(tmp_path: Path) -> None:
    paths = export(rack_timing(), "json", tmp_path)
    assert json.loads(paths[1].read_text())["phases"][0]["name"] == "approach"
    with pytest.raises(SettingsError, match="unknown target"):
        export(rack_job(), "xml", tmp_path)
    with pytest.raises(SettingsError, match="no timing to export"):
        export(replace(rack_timing(), carry=None), "csv", tmp_path)
    with pytest.raises(SettingsError, match="time step"):
        export(rack_job(), "csv", tmp_path, options=BundleOptions(step=-1.0))
