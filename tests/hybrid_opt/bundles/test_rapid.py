"""The RAPID modules, read by a parser that knows nothing of what writes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.bundles.arms import ABB, UR, require_maker
from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.bundles.rapid import rapid_files
from hybrid_opt.job.records import sample_job
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import sampled, text_of
from tests.hybrid_opt.bundles.rapid_parser import Call, Module, RapidError, parse
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.robots import ur10_urdf

NAMES = ("T_ROB1/Carry1.mod", "T_ROB2/Carry2.mod")


def modules() -> list[Module]:
    return [parse(text_of("rapid", name).encode("ascii").decode("ascii")) for name in NAMES]


def moves(module: Module) -> list[Call]:
    """All moves in the order in which Carry runs them."""
    found = []
    for call in module.procedures["Carry"]:
        found += [c for c in module.procedures.get(call.name, []) if c.name == "MoveAbsJ"]
    return found


def test_both_tasks_drive_every_phase() -> None:
    job = sampled(0.1)
    ids = []
    for arm, module in enumerate(modules()):
        assert module.name == f"Carry{arm + 1}"
        called = [call.name for call in module.procedures["Carry"]]
        assert called[:2] == ["CarryCheckStart", "SyncMoveOn"]
        assert called[-1] == "SyncMoveOff"
        phases = [name.removeprefix("Carry_") for name in called if name.startswith("Carry_")]
        assert phases == [phase.name for phase in rack_job().phases]
        found = moves(module)
        ids.append([call.optional["ID"] for call in found])
        assert len(found) == len(job.time) - 1
        total = sum(float(str(call.optional["T"])) for call in found)
        assert total == pytest.approx(job.time[-1], abs=1e-3)
        for k, call in enumerate(found, start=1):
            target = call.arguments[0]
            assert isinstance(target, list)
            robot, external = target
            assert external == [9e9] * 6
            degrees = np.rad2deg(job.arm(arm, job.q)[k])
            np.testing.assert_allclose(np.array(robot, dtype=float), degrees, atol=1e-6)
            assert call.arguments[2] == ("fine" if k in job.last else "z1")
            assert call.arguments[3] == "carryPad"
    assert ids[0] == ids[1]
    assert (np.diff(np.array(ids[0], dtype=float)) > 0.0).all()


def test_nothing_moves_before_the_start_is_checked() -> None:
    for module in modules():
        check = module.procedures["CarryCheckStart"]
        assert [call.name for call in check].count("IF") == 6
        assert [call.name for call in check].count("Stop") == 6
        assert not any(call.name.startswith("Move") for call in check)
        first = next(value for _, _, name, value in module.declarations if name == "carryFirst")
        assert isinstance(first, list)


def test_tool_load_and_forces_are_declared() -> None:
    cell = rack().workcell
    for arm, module in enumerate(modules()):
        declared = {name: (kind, value) for _, kind, name, value in module.declarations}
        kind, tool = declared["carryPad"]
        assert kind == "tooldata"
        assert isinstance(tool, list)
        held, frame, load = tool
        assert held == "TRUE"
        assert isinstance(frame, list)
        assert frame[0] == [0.0, 0.0, 190.0]
        assert frame[1] == [1.0, 0.0, 0.0, 0.0]
        assert isinstance(load, list)
        assert len(load) == 6
        kind, box = declared["carryHalfBox"]
        assert kind == "loaddata"
        assert isinstance(box, list)
        assert box[0] == cell.payload.mass / 2.0
        # The box's centre lies half its width behind the pad and 55 mm below.
        np.testing.assert_allclose(np.abs(np.array(box[1], dtype=float)), [55.0, 0.0, 200.0])
        _, force = declared["carryForceNewton"]
        _, at = declared["carryForceTime"]
        job = sampled(0.1)
        table = np.interp(job.time, np.array(at, dtype=float), np.array(force, dtype=float))
        assert (table >= job.normal_force[:, arm] - 1e-3).all()
        assert table.max() == pytest.approx(job.normal_force[:, arm].max(), abs=0.5)
        calls = [c for body in module.procedures.values() for c in body if c.name == "CarryForce"]
        assert len(calls) > 20
        assert module.parameters["CarryForce"] == [("num", "newton")]
    # The arm that presses stops where no force control is connected.
    stops = [[c.name for c in m.procedures["CarryForce"]].count("Stop") for m in modules()]
    assert stops == [0, 1]


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
    sample = sample_job(replace(job, workcell=evil), 0.1)
    text = rapid_files(sample, BundleOptions())[NAMES[0]]
    assert isinstance(text, str)
    assert "EXIT" not in {
        call.name
        for calls in parse(text.encode("ascii").decode("ascii")).procedures.values()
        for call in calls
    }


def test_steps_that_no_controller_plans_are_refused() -> None:
    with pytest.raises(SettingsError, match="RAPID"):
        rapid_files(sample_job(rack_job(), 0.004), BundleOptions())


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
