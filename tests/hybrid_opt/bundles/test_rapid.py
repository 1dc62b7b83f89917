"""The RAPID modules, read by a parser that knows nothing of what writes them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rapidchecker.check import check_format
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles import TARGETS, BundleOptions
from hybrid_opt.bundles.abb import rapid_files, require_rapid
from hybrid_opt.bundles.arms import ABB, UR, require_maker
from hybrid_opt.bundles.bundle import prepared
from hybrid_opt.bundles.job_file import pad_places
from hybrid_opt.job.compliance import HELD
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import inverse
from tests.hybrid_opt.bundles.bundles import driven, exported, rack_driven, text_of
from tests.hybrid_opt.bundles.rapid_parser import Call, Module, RapidError, parse
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.robots import ur10_urdf

EGM = ("T_ROB1/CarryEgm1.mod", "T_ROB2/CarryEgm2.mod")
NAMES = ("T_ROB1/Carry1.mod", "T_ROB2/Carry2.mod")
FORCE = ("FCPress1LStart", "FCPressL", "FCPressEnd")


def modules() -> list[Module]:
    return [parse(text_of("abb-rapid", name).encode("ascii").decode("ascii")) for name in NAMES]


def called(module: Module, *names: str) -> list[Call]:
    """All calls of some names in the order in which Carry runs them."""
    found = []
    for call in module.procedures["Carry"]:
        found += [c for c in module.procedures.get(call.name, []) if c.name in names]
    return found


def test_others_read_the_modules() -> None:
    """rapidchecker, which refuses broken ones."""
    for target, names in (("abb-rapid", NAMES), ("abb-egm", EGM)):
        for name in names:
            text = shortened(text_of(target, name).replace("\r\n", "\n"))
            assert not problems(text), problems(text)
            for broken in (
                text.replace("ENDPROC", "", 1),
                text.replace(":=", "=", 1),
                text.replace(";", "", 1),
                text.replace("[", "", 1),
            ):
                assert problems(broken)


def shortened(text: str) -> str:
    """Two moves of each kind, because rapidchecker takes a minute for hundreds."""
    lines, seen = [], Counter[str]()
    for line in text.splitlines():
        words = line.split()
        name = words[0] if words else ""
        seen[name] += name.startswith(("MoveAbsJ", "FCPressL"))
        if seen[name] <= 2:
            lines.append(line)
    return "\n".join(lines) + "\n"


def problems(text: str) -> list[str]:
    """What rapidchecker says against a module, its indentation aside."""
    try:
        found = check_format(text)
    except Exception as error:
        return [str(error)]
    return [str(each) for each in found if "indent" not in str(each).lower()]


def test_both_tasks_meet_before_every_phase() -> None:
    for arm, module in enumerate(modules()):
        assert module.name == f"Carry{arm + 1}"
        names = [call.name for call in module.procedures["Carry"]]
        phases = [phase.name for phase in rack_job().phases]
        assert [n.removeprefix("Carry_") for n in names if n.startswith("Carry_")] == phases
        assert names.index("CarryCheckStart") < names.index("WaitSyncTask")
        meetings = [c for c in module.procedures["Carry"] if c.name == "WaitSyncTask"]
        assert len(meetings) == len(phases) + 1
        for number, call in enumerate(meetings, start=1):
            assert "\\InPos" in str(call.arguments[0]) or "InPos" in call.optional
            assert f"carryMeet{number}" in call.arguments
        # Force Control excludes synchronised moves.
        assert not {"SyncMoveOn", "SyncMoveOff"} & set(names)
        assert "ERR_WAITSYNCTASK" in text_of("abb-rapid", NAMES[arm]), "nobody waits for ever"


def test_the_leader_drives_the_job() -> None:
    job, module = exported("abb-rapid").sampled, modules()[0]
    found = called(module, "MoveAbsJ")
    moving = [p.name for p in rack_job().phases if p.name not in ("press", "release")]
    spans = [job.span(k) for k, p in enumerate(rack_job().phases) if p.name in moving]
    places = np.concatenate([np.arange(s.start + 1, s.stop) for s in spans])
    assert len(found) == len(places)
    for k, call in zip(places, found, strict=True):
        target = call.arguments[0]
        assert isinstance(target, list)
        robot, external = target
        assert external == [9e9] * 6
        degrees = np.rad2deg(job.arm(0, job.q)[k])
        np.testing.assert_allclose(np.array(robot, dtype=float), degrees, atol=1e-6)
        step = float(job.time[k] - job.time[k - 1])
        assert float(str(call.optional["T"])) == pytest.approx(step, abs=1e-6)
        assert call.arguments[2] == ("fine" if k in job.last else "z1")


def test_the_other_presses_with_every_move() -> None:
    sheet, module = exported("abb-rapid"), modules()[1]
    job = sheet.sampled
    start, *moves, end = called(module, *FORCE)
    assert (start.name, end.name) == ("FCPress1LStart", "FCPressEnd")
    spans = [job.span(k) for k, p in enumerate(rack_job().phases) if p.name in HELD]
    places = np.concatenate([np.arange(s.start + 1, s.stop) for s in spans])
    assert len(moves) == len(places)
    declared = {name: value for _, _, name, value in module.declarations}
    uframe = declared["carryGrip"][3]  # type: ignore[index]
    robot = sheet.workcell.robots[1]
    for k, call in zip(places, moves, strict=True):
        place, speed, force = call.arguments[:3]
        assert float(str(force)) >= job.normal_force[k - 1 : k + 1, 1].max() - 1e-3
        assert float(str(force)) <= job.normal_force[:, 1].max() + 1e-3
        # Work object and target together: where the pad has to be.
        T = frame(uframe) @ frame(place)
        pad = inverse(robot.T_world_base) @ pad_places(sheet.workcell, 1, job.q[k : k + 1, 6:])[0]
        np.testing.assert_allclose(T[:3, 3], 1e3 * pad[:3, 3], atol=1e-2)
        np.testing.assert_allclose(T[:3, :3], pad[:3, :3], atol=1e-5)
        assert len(speed) == 4  # type: ignore[arg-type]
    signs = declared["carrySign"]
    assert signs == 0.0, "nobody has tried the sign: the program ends until someone has"
    main = [c for c in module.procedures["Carry"] if c.name == "IF"]
    assert "carrySign" in str(main[0].arguments[0])


def frame(pose: Any) -> Array:
    """A transform of a RAPID pose [mm]."""
    T = np.eye(4)
    w, x, y, z = (float(value) for value in pose[1])
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = [float(value) for value in pose[0]]
    return T


def test_nothing_moves_before_the_start_is_checked() -> None:
    for module in modules():
        check = module.procedures["CarryCheckStart"]
        assert [call.name for call in check].count("IF") == 6
        assert [call.name for call in check].count("EXIT") == 6
        assert not any(call.name.startswith("Move") for call in check)
        first = next(value for _, _, name, value in module.declarations if name == "carryFirst")
        assert isinstance(first, list)
        assert all("Stop" not in {c.name for c in body} for body in module.procedures.values())


def test_tool_and_load_are_declared() -> None:
    cell = rack().workcell
    for module in modules():
        declared = {name: (kind, value) for _, kind, name, value in module.declarations}
        kind, tool = declared["carryPad"]
        assert kind == "tooldata"
        assert isinstance(tool, list)
        held, place, load = tool
        assert held == "TRUE"
        assert isinstance(place, list)
        assert place[0] == [0.0, 0.0, 190.0]
        assert place[1] == [1.0, 0.0, 0.0, 0.0]
        assert isinstance(load, list)
        assert len(load) == 6
        kind, box = declared["carryHalfBox"]
        assert kind == "loaddata"
        assert isinstance(box, list)
        assert box[0] == cell.payload.mass / 2.0
        # The box's centre lies half its width behind the pad and 55 mm below.
        np.testing.assert_allclose(np.abs(np.array(box[1], dtype=float)), [55.0, 0.0, 200.0])


def test_arms_of_other_makers_are_refused() -> None:
    cell = rack().workcell
    require_maker(cell, ABB, "RAPID", any_arm=False)
    with pytest.raises(SettingsError, match=r"gofa12.urdf.*UR e-series"):
        require_maker(cell, UR, "URScript", any_arm=False)
    other = replace(cell.robots[0], urdf=ur10_urdf(), chain_root="")
    with pytest.raises(SettingsError, match="ABB"):
        require_maker(replace(cell, robots=(other, cell.robots[1])), ABB, "RAPID", any_arm=False)
    require_maker(replace(cell, robots=(other, other)), ABB, "RAPID", any_arm=True)


def test_names_cannot_leave_a_comment() -> None:
    job = rack_job()
    robot, other = job.workcell.robots
    robots = (replace(robot, name="räbot \n"), other)
    evil = replace(job.workcell, name="x\r\n  EXIT;\n", robots=robots)
    sheet = prepared(
        driven(replace(job, workcell=evil)), TARGETS["abb-rapid"], BundleOptions(step=0.1)
    )
    text = rapid_files(sheet)[NAMES[0]]
    assert isinstance(text, str)
    assert "x" not in parse(text.encode("ascii").decode("ascii")).procedures
    assert text.count("EXIT;") == text_of("abb-rapid", NAMES[0]).count("EXIT;") + 1
    assert "! x??  EXIT;?" in text


def test_steps_that_no_controller_plans_are_refused() -> None:
    with pytest.raises(SettingsError, match="RAPID"):
        rapid_files(prepared(rack_driven(), TARGETS["abb-rapid"], BundleOptions(step=0.004)))


def test_a_box_that_turns_is_refused() -> None:
    """The force keeps its direction in the room."""
    (carry,) = (phase for phase in rack_job().phases if phase.name == "carry")
    pose = carry.motion.pose.copy()
    pose[:, 5] += np.linspace(0.0, 0.5, len(pose))
    turned = replace(carry, motion=replace(carry.motion, pose=pose))
    phases = tuple(turned if p.name == "carry" else p for p in rack_job().phases)
    with pytest.raises(SettingsError, match="the box turns by 29 degrees"):
        require_rapid(replace(rack_driven(), phases=phases))


@pytest.mark.parametrize(
    "text",
    [
        "MODULE A PROC B() MoveAbsJ [[1]] v50; ENDPROC ENDMODULE",
        "MODULE A PROC B() MoveAbsJ [[1], v50; ENDPROC ENDMODULE",
        "MODULE A PROC B() MoveAbsJ x \\ID:=1 \\ID:=2; ENDPROC ENDMODULE",
        "MODULE A PERS num x{2} := [1]; ENDMODULE",
        "MODULE A PROC B() IF x THEN Stop; ENDPROC ENDMODULE",
        "MODULE A PROC B() ENDPROC",
        "MODULE 1A ENDMODULE",
    ],
)
def test_the_parser_refuses_wrong_rapid(text: str) -> None:
    with pytest.raises((RapidError, IndexError)):
        parse(text)
