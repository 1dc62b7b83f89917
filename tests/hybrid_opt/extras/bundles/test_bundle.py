"""Bundles keep to their own folders: nobody's files are lost, whatever is in the way."""

from __future__ import annotations

import errno
import itertools
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.errors import JobError, ResultsError
from hybrid_opt.extras.bundles import BundleOptions, Origin, export
from hybrid_opt.extras.bundles.job_file import pad_places
from hybrid_opt.extras.bundles.targets import missing_for
from hybrid_opt.job.records import Job, sample_job
from hybrid_opt.store.bundle_file import read_manifest, write_bundle
from hybrid_opt.store.files import sha256
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.cell import ToolLoad
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, driven, rack_driven
from tests.hybrid_opt.job.jobs import rack_job, rack_jobs, rack_timing
from tests.refusals import refused

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
    ("name", "content", "code"),
    [
        ("notes.txt", "mine", "foreign-file"),
        ("a.txt", "edited", "changed-file"),
        ("manifest.json", "{}", "in-the-way"),
        ("manifest.json", "{", "in-the-way"),
        ("manifest.json", None, "in-the-way"),
    ],
)
def test_foreign_and_edited_files_stay(
    tmp_path: Path, name: str, content: str | None, code: str
) -> None:
    folder = tmp_path / "bundle"
    write_bundle(folder, FILES, {"note": "as written"})
    own = (folder / "manifest.json").read_text().replace("as written", "mine")
    (folder / name).write_text(own if content is None else content)
    before = tree(tmp_path)
    with refused(ResultsError, code):
        write_bundle(folder, FILES, {})
    assert tree(tmp_path) == before


def test_a_file_or_link_in_the_way_stays(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    for name in ("file", "link"):
        with refused(ResultsError, "in-the-way", name):
            write_bundle(tmp_path / name, FILES, {})
    with refused(ResultsError, "not-writable"):
        write_bundle(tmp_path / "file" / "bundle", FILES, {})
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(("call", "code"), [("fsync", errno.ENOSPC), ("rename", errno.EIO)])
def test_what_cannot_be_written_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, code: int
) -> None:
    """Neither where a file cannot be stored, nor where the exchange of both is interrupted."""
    folder = tmp_path / "bundle"
    write_bundle(folder, FILES, {})
    before = tree(tmp_path)
    usual, count = getattr(os, call), itertools.count(1)

    def second_fails(*given: Any) -> None:
        if next(count) == 2:
            raise OSError(code, os.strerror(code))
        usual(*given)

    monkeypatch.setattr(os, call, second_fails)
    with pytest.raises(ResultsError, match=str(folder)):
        write_bundle(folder, {"other.txt": "new"}, {})
    assert tree(tmp_path) == before


def test_different_carries_never_touch_one_another(tmp_path: Path) -> None:
    """Neither one that presses more, nor another path."""
    origin, job = Origin("rack", "nsga2", 3, 12), rack_job()
    more = [replace(p, force=replace(p.force, normal=1.1 * p.force.normal)) for p in job.phases]
    carry = job.timing.carry
    assert carry is not None
    other = replace(job.timing, carry=replace(carry, x=carry.x + 1e-9))
    how: dict[str, Any] = {"origin": origin, "options": BundleOptions(step=0.1)}
    first = export(job, "data", tmp_path, **how)
    before = tree(tmp_path)
    folders = {first[0].parent}
    for each in (replace(job, phases=tuple(more)), replace(job, timing=other)):
        folders.add(export(each, "data", tmp_path, **how)[0].parent)
    assert len(folders) == 3
    assert all(folder.parent.name.startswith("rack-nsga2-r03-p0012-") for folder in folders)
    assert export(job, "data", tmp_path, **how) == first
    assert {name: tree(tmp_path)[name] for name in before} == before


def test_names_are_names_of_files() -> None:
    for study in ("a/../b", "..", "räck  x", "x" * 500, "\0"):
        name = Origin(study, "nsga2-polished").name(rack_job())
        assert set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
        assert len(name) < 120
    selected = Path("results/rack/selected/mopso-polished/07.json")
    for path, provenance, begin in (
        (selected, {"replica": 7, "row": 41}, "rack-mopso-polished-r07-p0041-"),
        (Path("my carry.json"), {"replica": "x"}, "my-carry-"),
    ):
        assert Origin.of_file(path, b"", provenance).name(rack_job()).startswith(begin)


def written(
    job: Job | Timing, target: str, folder: Path, name: str = "manifest.json", **options: Any
) -> Any:
    """What a bundle's file holds."""
    paths = export(job, target, folder, options=BundleOptions(**options))
    return json.loads(next(path for path in paths if path.name == name).read_text())


def test_the_manifest_says_what_it_is(tmp_path: Path) -> None:
    document = written(rack_job(), "data", tmp_path, step=0.1)
    (table,) = tmp_path.rglob("job.csv")
    assert document["files"]["job.csv"] == sha256(table.read_bytes())
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
    assert "wrists" in squeeze["assumes"]
    assert document["units"]["force"] == "N"
    (page,) = (path.read_text() for path in tmp_path.rglob("README.md"))
    assert f"{document['duration']:.2f} s" in page
    assert f"{squeeze['force']:.1f} N" in page
    assert all(f"`{name}`" in page for name in document["files"] if name != "README.md")
    assert all(warning in page for warning in document["warnings"])
    assert document["how_to_run"]
    assert any("tool_load" in warning for warning in document["warnings"])
    rough = written(rack_jobs().plan(rack_timing(), smoothing=0.0), "data", tmp_path, step=0.1)
    for found, is_told in ((document, False), (rough, True)):
        assert any("acceleration" in warning for warning in found["warnings"]) == is_told
    assert document["start_skew"] == {
        "how": "up to what plays the file",
        "required": None,
        "stiffness": None,
    }
    assert document["time_step"] == {"step": pytest.approx(0.1, rel=0.1)}
    skew = written(rack_driven(), "data", tmp_path, step=0.1)["start_skew"]
    assert [each["delay"] for each in skew["cases"]] == [0.001, 0.002, 0.005, 0.01, 0.02]
    for each in skew["cases"]:
        assert each["holds"] == (each["delay"] <= skew["survived"])
    assert skew["required"] is None


def test_the_manifest_says_how_the_job_stops(tmp_path: Path) -> None:
    document = written(rack_job(), "torque", tmp_path)
    machine, step = document["machine"], document["time_step"]
    assert set(machine["states"]) == {*("ready", "running", "stopping", "landing", "held", "done")}
    assert machine["carried_out_by"].startswith("run_job.py")
    assert machine["stop"]["force_use"] <= 1.0
    assert machine["limits"]["stop_time"] == machine["stop"]["time"]
    assert "'back'" in machine["set_down"]
    assert step["interpolation"] == "quintic"
    assert step["share"] <= step["allowed_share"]
    assert step["force"] == pytest.approx(step["stiffness"] / 2.0 * step["along"])


def test_one_arms_stop_costs_distance(tmp_path: Path) -> None:
    """The pads are apart by what their speed covers until the other arm stands; a cell may allow
    less, and the smaller limit that its refusal names is enough for the same distance over time."""
    stop = written(rack_job(), "torque", tmp_path)["machine"]["partner_stop"]
    speed = max(
        float(np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1).max() / 1e-3)
        for arm in (0, 1)
        for places in [pad_places(rack_job().workcell, arm, fine_positions(arm))]
    )
    assert stop["distance"] == pytest.approx(speed * stop["time"], rel=0.02)
    assert stop["survived"] < stop["distance"]
    assert stop["allowed"] is None
    (page,) = (path.read_text() for path in tmp_path.rglob("README.md"))
    assert f"partner_stop = {stop['survived']:.3f}" in page

    def limited(allowed: float) -> Job:
        cell = rack_job().workcell
        handling = replace(cell.handling, partner_stop=allowed)
        return replace(rack_job(), workcell=replace(cell, handling=handling))

    enough = written(limited(1.01 * stop["distance"]), "torque", tmp_path)
    assert enough["machine"]["partner_stop"]["distance"] == stop["distance"]
    with refused(JobError, "partner-stop", "20 mm") as refusal:
        written(limited(0.02), "torque", tmp_path)
    named = float(str(refusal.value).rpartition("partner_stop = ")[2].partition(",")[0])
    assert named * stop["distance"] == pytest.approx(0.02**2, rel=0.05)


def fine_positions(arm: int) -> Array:
    """(n, joints) of an arm in the carry, every millisecond."""
    sampled = sample_job(rack_job(), 1e-3)
    (index,) = (k for k, phase in enumerate(rack_job().phases) if phase.name == "carry")
    return sampled.arm(arm, sampled.q[sampled.span(index)])


def test_two_controllers_have_to_survive_their_skew(tmp_path: Path) -> None:
    """One clock needs nothing; where each arm plans by itself, 10 ms or what is asked for."""
    stiff: dict[str, Any] = {"step": 0.1, "stiffness": 5e4}
    skew = written(rack_job(), "torque", tmp_path, **stiff)["start_skew"]
    assert skew["required"] == 0.0
    assert skew["survived"] < 0.01
    with refused(JobError, "skew-too-long", "20 ms"):
        written(rack_driven(), "data", tmp_path, skew=0.02, **stiff)
    skew = written(rack_driven(), "data", tmp_path, skew=1e-3, **stiff)["start_skew"]
    assert skew["required"] == 1e-3
    with refused(SettingsError, "no-stiffness"):
        written(rack_job(), "data", tmp_path, skew=1e-3)


def test_arms_in_series_have_the_mean_compliance(tmp_path: Path) -> None:
    job = rack_driven()
    first, second = job.workcell.robots
    stiff = replace(second, driver=replace(DRIVER, stiffness=3e4))
    job = replace(job, workcell=replace(job.workcell, robots=(first, stiff)))
    found = written(job, "data", tmp_path, step=0.1)["start_skew"]["stiffness"]
    assert found == pytest.approx(2.0 * (1e4 * 3e4) / (1e4 + 3e4))


def by(**stated: Any) -> Job:
    """The rack's job by drivers with something else stated."""
    return driven(rack_job(), replace(DRIVER, **stated))


REFUSED: list[tuple[str, Callable[[], Job | Timing], dict[str, Any], str, str]] = [
    ("torque", by, {}, "no-driver", "abb-egm"),
    ("ur-script", by, {}, "another-maker", "UR"),
    ("abb-egm", lambda: by(force_control=False), {}, "no-force-control", "export --driver"),
    ("abb-egm", lambda: by(lag=0.0), {}, "no-lag", "'left'"),
    ("abb-egm", lambda: by(stiffness=None), {}, "no-stiffness", "'left'"),
    ("torque", lambda: by(prefix="same_", address=""), {}, "prefix", "'same_'"),
    ("abb-egm", lambda: by(address=""), {}, "no-address", "--address"),
    ("abb-egm", by, {"addresses": ("a b", "c")}, "wrong-address", "'a b'"),
    ("xml", by, {}, "unknown-target", "'xml'"),
    ("abb-rapid", by, {}, "former-target", "abb-egm"),
    ("data", lambda: replace(rack_timing(), carry=None), {}, "no-timing", ""),
    ("data", by, {"step": -1.0}, "range", "-1 s"),
    ("data", by, {"skew": -1.0}, "skew", "-1"),
]


@pytest.mark.parametrize(("target", "job", "options", "code", "quoted"), REFUSED)
def test_a_target_says_what_it_lacks(
    target: str,
    job: Callable[[], Job | Timing],
    options: dict[str, Any],
    code: str,
    quoted: str,
    tmp_path: Path,
) -> None:
    with refused(SettingsError, code, quoted):
        written(job(), target, tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_a_cell_says_what_it_lacks_for_a_target() -> None:
    """Before any carry, in the words that refuse an export."""
    bare, equipped = by(address="", force_control=False, stiffness=None).workcell, by().workcell
    told = missing_for("abb-egm", bare)
    wanted = ("--address", "force_control", "--stiffness", "tool_load", "tool_load")
    assert len(told) == len(wanted)
    assert all(word in problem for word, problem in zip(wanted, told, strict=True))
    loads = tuple(replace(robot, tool_load=ToolLoad(0.5)) for robot in equipped.robots)
    assert missing_for("abb-egm", replace(equipped, robots=(loads[0], loads[1]))) == ()
    assert "abb-egm" in missing_for("torque", equipped)[0]
    with refused(SettingsError, "unknown-target"):
        missing_for("xml", bare)


def test_the_other_arm_is_named_where_it_can_press(tmp_path: Path) -> None:
    job = by(force_control=False)
    leader, robots = job.squeeze.leader, list(job.workcell.robots)
    robots[leader] = replace(robots[leader], driver=DRIVER)
    job = replace(job, workcell=replace(job.workcell, robots=(robots[0], robots[1])))
    told = f"let '{robots[leader].name}' press, which has it \\(--leader {2 - leader}\\)"
    with pytest.raises(SettingsError, match=told):
        export(job, "abb-egm", tmp_path)


def test_joints_have_names_of_their_own(tmp_path: Path) -> None:
    """As drivers name them: by the robot, or by a prefix that is stated."""
    job = by(prefix="same_")
    first, second = job.workcell.robots
    named = replace(first, driver=replace(DRIVER, prefix="l_"))
    job = replace(job, workcell=replace(job.workcell, robots=(named, second)))
    robots = written(job, "data", tmp_path, "job.json", step=0.1)["robots"]
    assert [robot["ros_joints"][0] for robot in robots] == ["l_joint_1", "same_joint_1"]


def test_a_driver_has_to_have_an_address(tmp_path: Path) -> None:
    hosts = ("10.0.0.1", "arm-2.local")
    config = written(by(address=""), "abb-egm", tmp_path, "egm.json", addresses=hosts)
    assert tuple(config["addresses"]) == hosts


def test_a_timing_is_exported_with_its_job(tmp_path: Path) -> None:
    job = written(rack_timing(), "data", tmp_path, "job.json", step=0.1)
    assert job["phases"][0]["name"] == "approach"
