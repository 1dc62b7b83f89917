"""The targets of an export by their names, and the data that a cell lacks for one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from hybrid_opt.extras.bundles.arms import (
    ABB,
    SECTION_OF_EACH,
    SERVICES,
    SEVEN,
    SIX,
    UR,
    Lines,
    require_arms,
)
from hybrid_opt.extras.bundles.data import data_files
from hybrid_opt.extras.bundles.egm import egm_files, require_egm
from hybrid_opt.extras.bundles.job_file import Contents, Export, Interpolation
from hybrid_opt.extras.bundles.torque import (
    TORQUE_STEPS,
    driver_of,
    pad_stiffness,
    require_torque,
    torque_files,
)
from hybrid_opt.extras.bundles.urscript import require_followed, urscript_files
from hybrid_opt.job.records import Job
from symbolic.contact.registry import contact_model, require_squeeze
from symbolic.errors import SettingsError
from symbolic.records import Workcell

SKEW = 0.01
"""Largest start skew expected of two controllers with clocks of their own [s]."""


@dataclass(frozen=True)
class Target:
    """A kind of bundle, by its drivers.

    Attributes:
        files: from an export to file contents by path.
        steps: time steps that it can have, the longest first [s].
        interpolation: how it moves between two samples.
        how_to_run: text for the README.
        reaction: text on who carries out a stop; '' for data that is not run.
        start: text on the common start of both arms.
        skew: delay between their starts that a job has to tolerate [s]; None if not checked.
        maker: of the arms, one of those of `hybrid_opt.extras.bundles.arms`; '' for all.
        axes: numbers of turning joints that a maker's targets can hold.
        has_address: it needs the addresses of the controllers.
        require: refuses a job before it is sampled, for further reasons.
        require_equipment: refuses a cell whose drivers lack something, given the index of the
            leading arm.
        lines: how it switches and hears hands that hold by themselves; None if it does not.
        stiffness: where that of the arms comes from: 'stated' by the cell, required; 'gains' that
            the bundle writes; '' if the target does not depend on it.
    """

    files: Callable[[Export], Contents]
    steps: tuple[float, ...]
    interpolation: Interpolation
    how_to_run: str
    reaction: str = ""
    start: str = "up to what plays the file"
    skew: float | None = None
    maker: str = ""
    axes: tuple[int, ...] = (SIX,)
    has_address: bool = False
    require: Callable[[Job], None] = lambda job: None
    require_equipment: Callable[[Workcell, int], None] = lambda workcell, leader: None
    lines: Lines | None = None
    stiffness: str = ""

    def refuse(self, job: Job, name: str, any_arm: bool) -> None:
        """Refuse a job that is not for this target of a name, before it is sampled.

        Args:
            any_arm: whether the user wants a maker's language for arms of others.

        Raises:
            SettingsError: the arms are not those that the target is for, or lack what it needs.
        """
        self.require_hands(job.workcell, name)
        if self.maker:
            needs = (self.maker, self.axes, self.has_address)
            require_arms(job.workcell, name, *needs, any_arm=any_arm)
        self.require_equipment(job.workcell, job.squeeze.leader)
        self.require(job)

    def require_hands(self, workcell: Workcell, name: str) -> None:
        """Refuse hands that hold by themselves if the target of a name does not reach them.

        Raises:
            SettingsError: it switches none, or not by the names of the drivers.
        """
        if contact_model(workcell).is_squeeze:
            return
        if self.lines is None:
            require_squeeze(workcell, f"the target {name}")
        else:
            self.lines.require(workcell, name)

    def stiffness_of(self, job: Job, name: str) -> float | None:
        """Return the stiffness of each arm at its pad [N/m]; None if nothing depends on it.

        Both arms hold the box in series: of k_1 and k_2 it is 2 / (1 / k_1 + 1 / k_2).

        Raises:
            SettingsError: the target depends on an unknown stiffness.
        """
        if self.stiffness == "gains":
            return pad_stiffness(job)
        return self.stated_stiffness(job.workcell, name)

    def stated_stiffness(self, workcell: Workcell, name: str) -> float | None:
        """Return the stiffness that a cell states; None if nothing depends on it.

        Raises:
            SettingsError: the target depends on an unknown stiffness.
        """
        first, second = (robot.driver.stiffness for robot in workcell.robots)
        if first is not None and second is not None:
            return 2.0 / (1.0 / first + 1.0 / second)
        if self.stiffness != "stated":
            return None
        unknown = next(r.name for r in workcell.robots if r.driver.stiffness is None)
        raise SettingsError(
            f"{name} presses as hard as the stiffness of {unknown!r} at its pad makes it, and "
            "nobody states that. Measure it: press both pads against one another, move one by 0.1 "
            "mm a step along the normal and read the force; equal arms have twice its slope. "
            f"Then write [robots.driver] with stiffness = ... in N/m into {SECTION_OF_EACH}, or "
            "export with --stiffness"
        )


RUN = "run_job.py looks at both arms a hundred times a second and replaces their goals"


CYCLE_SKEW = 0.002
"""Largest skew of two drivers with the same start time in their goals: one cycle [s]."""


_TORQUE = Target(
    torque_files,
    TORQUE_STEPS,
    "quintic",
    "start your simulator with description/cell.urdf, ros2 launch launch/simulation.launch.py, "
    "python3 run_job.py --bring-up without a box, then python3 run_job.py",
    RUN,
    "one controller drives all joints: both arms start in the same cycle",
    0.0,
    require=require_torque,
    lines=SERVICES,
    stiffness="gains",
)


_DRIVEN = replace(
    _TORQUE,
    start="the goals of both controllers bear one start time of one computer's clock",
    skew=CYCLE_SKEW,
)


TORQUE_DRIVERS: Mapping[str, Target] = {
    "simulation": _TORQUE,
    "franka": replace(
        _DRIVEN,
        how_to_run="no end effector in Desk; ros2 launch launch/franka.launch.py, python3 "
        "run_job.py --bring-up without a box, then python3 run_job.py",
    ),
    "ur": replace(
        _DRIVEN,
        lines=Lines(
            r"\d|1[0-7]|/.+",
            r"\d|1[0-7]|/.+",
            "the number of a digital line, 0 to 17, or by services and topics of ROS, /NAME each",
        ),
        how_to_run="PolyScope 5.25.1 or 10.12.1, no TCP offset; power both arms on and release "
        "their brakes; ros2 launch launch/ur.launch.py, python3 run_job.py --bring-up without a "
        "box, then python3 run_job.py",
    ),
}
"""The torque target by its drivers."""


TARGETS: Mapping[str, Target] = {
    "torque": _TORQUE,
    "abb-egm": Target(
        egm_files,
        (0.02, 0.01, 0.005),
        "cubic",
        "load T_ROB1/CarryEgm1.mod and T_ROB2/CarryEgm2.mod, jog both robots to carryFirst, run "
        "CarryEgm in both tasks, python3 run_egm.py --bring-up without a box, then, with CarryEgm "
        "run again, python3 run_egm.py",
        "run_egm.py streams both arms from one clock and lets it stand still",
        "one clock streams the positions of both arms",
        0.004,
        ABB,
        (SIX, SEVEN),
        has_address=True,
        require_equipment=require_egm,
        stiffness="stated",
    ),
    "ur-script": Target(
        urscript_files,
        (0.008, 0.004, 0.002),
        "linear",
        "a draft that nobody has run on a controller: wire digital outputs 0 and 1 of each arm to "
        "inputs 0 and 1 of the other, move both arms to the first position, run one program on "
        "each; first without the box",
        "either program stretches the time of its points until it stands, servoj and force mode "
        "hold; so does the other's as soon as the heartbeat on output 1 stops",
        "both programs meet before the job over a digital line each way: what remains is a cycle "
        "and the lines' latency",
        SKEW,
        UR,
        require=require_followed,
        lines=Lines(
            "[2-7]",
            "[4-7]",
            "numbers of digital lines, outputs 2 to 7 and inputs 4 to 7 of its own",
        ),
        stiffness="stated",
    ),
    "data": Target(
        data_files,
        (0.008,),
        "cubic",
        "read job.csv with anything; job.schema.json describes job.json; open job.mcap in "
        "Foxglove, or play it: ros2 bag play job.mcap",
        lines=Lines(".*", ".*", ""),
    ),
}
"""Every target by its name; `TORQUE_DRIVERS` has the drivers of torque."""


GONE = {
    "ros2-control": "torque",
    "franka-ros2": "torque",
    "ur-ros2": "torque (direct torque from PolyScope 5.23 or 10.10), or the draft ur-script",
    "abb-rapid": "abb-egm",
    "csv": "data",
    "json": "data",
    "mcap": "data",
}
"""Targets of earlier versions, and their replacements."""


def require_target(name: str) -> None:
    """Refuse an unknown target, and one that is no longer written."""
    if name in GONE:
        raise SettingsError(f"target {name!r} is no longer written; use {GONE[name]}")
    if name not in TARGETS:
        raise SettingsError(
            f"unknown target {name!r}; known are {', '.join(TARGETS)}", code="unknown-target"
        )


def target_for(name: str, workcell: Workcell) -> Target:
    """Return the target of a name, with the driver that the cell's arms have.

    Raises:
        SettingsError: the name is unknown, or no driver takes torques for these arms.
    """
    require_target(name)
    return TORQUE_DRIVERS[driver_of(workcell)] if name == "torque" else TARGETS[name]


def missing_for(name: str, workcell: Workcell, leader: int = 0) -> tuple[str, ...]:
    """List the data that a cell lacks for a target, before any carry is known.

    Args:
        name: of the target.
        leader: index of the arm that keeps its place.

    Raises:
        SettingsError: the target is unknown.
    """
    require_target(name)
    try:
        found = target_for(name, workcell)
    except SettingsError as error:
        return (str(error),)
    arms = partial(require_arms, workcell, name, found.maker, found.axes)
    checks: list[Callable[[], object]] = [arms] if found.maker else []
    checks += [partial(arms, has_address=True)] if found.maker and found.has_address else []
    checks += [partial(found.require_equipment, workcell, leader)]
    checks += [partial(found.require_hands, workcell, name)]
    checks += (
        [partial(found.stated_stiffness, workcell, name)] if found.stiffness != "gains" else []
    )
    problems = list[str]()
    for check in checks:
        try:
            check()
        except SettingsError as error:
            problems.append(str(error))
    return (*dict.fromkeys(problems), *missing_loads(workcell))


def missing_loads(workcell: Workcell) -> list[str]:
    """List the robots whose tool loads are not given, as warnings."""
    return [
        f"no tool_load is given for {robot.name}: torques and tool data leave out the pad's mass"
        for robot in workcell.robots
        if robot.tool_load is None
    ]


def missing_text(name: str, workcell: Workcell) -> str:
    """List the data that a cell lacks for a target, for a terminal.

    Raises:
        SettingsError: the target is unknown.
    """
    problems = missing_for(name, workcell)
    if not problems:
        return f"{name}: the cell states all that the target needs"
    listed = "".join(f"\n  - {problem}" for problem in problems)
    return (
        f"{name} needs more than the cell states; drivers and tool loads may follow, by export "
        f"--driver FILE:{listed}"
    )


def targets() -> dict[str, str]:
    """Return the targets of `export`: how to run each, by name."""
    return {name: target.how_to_run for name, target in TARGETS.items()}
