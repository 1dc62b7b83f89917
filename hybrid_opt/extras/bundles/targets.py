"""The targets of an export by name, and the data that a cell lacks for a target."""

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

SKEW, CYCLE_SKEW = 0.01, 0.002
"""Largest expected delay between the starts of two controllers [s]: with separate clocks, and of
drivers with the same start time in their goals, one cycle."""


@dataclass(frozen=True)
class Target:
    """A kind of bundle, for one kind of driver.

    Attributes:
        files: function from an export to file contents by path.
        steps: possible time steps, the longest first [s].
        interpolation: the driver's interpolation between two samples.
        how_to_run: text for the README.
        reaction: text on who carries out a stop; '' for data that is not run.
        start: text that says who starts both arms at the same time.
        skew: delay between the starts of both arms that a job has to tolerate [s]; None if not
            checked.
        maker: maker of the arms, one of those in `hybrid_opt.extras.bundles.arms`; '' for all.
        axes: numbers of joints per arm that the target supports.
        has_address: True if the target needs the addresses of the controllers.
        require: function that raises an error for a job that the target cannot run; it is called
            before the job is sampled.
        require_equipment: function of a cell and the index of the leader that raises an error if a
            driver lacks something.
        lines: names that are allowed for outputs and inputs of hands; None if the target does not
            switch hands.
        stiffness: source of the arms' stiffness: 'stated' if the cell has to state it, 'gains' if
            it follows from the gains in the bundle, '' if the target needs none.
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

    def checks(
        self, workcell: Workcell, name: str, leader: int, any_arm: bool = False
    ) -> list[Callable[[], object]]:
        """Return the checks whether a cell fits this target, as functions that raise a
        SettingsError if it does not.

        They check its hands, the maker and joints of its arms, their addresses, and their
        equipment.

        Args:
            workcell: the cell.
            name: name of the target, for messages.
            leader: index of the position-controlled arm.
            any_arm: True to accept arms that do not look like those of the target's maker.
        """
        arms = partial(require_arms, workcell, name, self.maker, self.axes, any_arm=any_arm)
        found: list[Callable[[], object]] = [partial(self.require_hands, workcell, name)]
        found += [arms, partial(arms, has_address=self.has_address)] if self.maker else []
        return [*found, partial(self.require_equipment, workcell, leader)]

    def refuse(self, job: Job, name: str, any_arm: bool) -> None:
        """Check, before a job is sampled, that this target can run it.

        Args:
            job: the job.
            name: name of the target, for messages.
            any_arm: True to accept arms that do not look like those of the target's maker.

        Raises:
            SettingsError: the arms are not of the target's maker, or lack something that it needs.
        """
        for check in self.checks(job.workcell, name, job.squeeze.leader, any_arm):
            check()
        self.require(job)

    def require_hands(self, workcell: Workcell, name: str) -> None:
        """Check that this target can switch the hands of a cell (cups, magnets or grippers).

        Args:
            workcell: the cell; without hands it always passes.
            name: name of the target, for messages.

        Raises:
            SettingsError: the target switches no hands, or the names of their outputs are not valid
                for it.
        """
        if contact_model(workcell).is_squeeze:
            return
        if self.lines is None:
            require_squeeze(workcell, f"the target {name}")
        else:
            self.lines.require(workcell, name)

    def stiffness_of(self, job: Job, name: str) -> float | None:
        """Return the stiffness of each arm at its pad for a job [N/m], from the joint gains or from
        the cell; None if the cell does not state it and the target needs none.

        Args:
            job: the job.
            name: name of the target, for messages.

        Raises:
            SettingsError: the target needs a stiffness that is unknown.
        """
        if self.stiffness == "gains":
            return pad_stiffness(job)
        return self.stated_stiffness(job.workcell, name)

    def stated_stiffness(self, workcell: Workcell, name: str) -> float | None:
        """Return the stiffness of each arm at its pad that a cell states [N/m]; None if it does not
        state both and the target needs none.

        Both arms hold the box like springs in series, so their stiffnesses k_1 and k_2 are averaged
        to 2 / (1 / k_1 + 1 / k_2).

        Args:
            workcell: the cell.
            name: name of the target, for messages.

        Raises:
            SettingsError: the target needs a stiffness that is unknown.
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
            "export with --stiffness",
            code="no-stiffness",
        )


_RUN = "python3 run_job.py --bring-up without a box, then python3 run_job.py"

_TORQUE = Target(
    torque_files,
    TORQUE_STEPS,
    "quintic",
    "start your simulator with description/cell.urdf, ros2 launch launch/simulation.launch.py, "
    + _RUN,
    "run_job.py looks at both arms a hundred times a second and replaces their goals",
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
        how_to_run=f"no end effector in Desk; ros2 launch launch/franka.launch.py, {_RUN}",
    ),
    "ur": replace(
        _DRIVEN,
        lines=Lines(
            r"\d|1[0-7]|/.+",
            r"\d|1[0-7]|/.+",
            "the number of a digital line, 0 to 17, or by services and topics of ROS, /NAME each",
        ),
        how_to_run="PolyScope 5.25.1 or 10.12.1, no TCP offset; power both arms on and release "
        f"their brakes; ros2 launch launch/ur.launch.py, {_RUN}",
    ),
}
"""The torque target of each driver, by the driver's name."""


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
"""Every target by its name; `TORQUE_DRIVERS` has the variants of the torque target."""


GONE = {
    "ros2-control": "torque",
    "franka-ros2": "torque",
    "ur-ros2": "torque (direct torque from PolyScope 5.23 or 10.10), or the draft ur-script",
    "abb-rapid": "abb-egm",
    "csv": "data",
    "json": "data",
    "mcap": "data",
}
"""Names of targets of earlier versions, with their replacements."""


def require_target(name: str) -> None:
    """Check that a target exists.

    Raises:
        SettingsError: the name is unknown, or the target is no longer written.
    """
    if name in GONE:
        raise SettingsError(
            f"target {name!r} is no longer written; use {GONE[name]}", code="former-target"
        )
    if name not in TARGETS:
        raise SettingsError(
            f"unknown target {name!r}; known are {', '.join(TARGETS)}", code="unknown-target"
        )


def target_for(name: str, workcell: Workcell) -> Target:
    """Return a target by name, in the variant for the drivers of the cell's arms.

    Raises:
        SettingsError: the name is unknown, or no driver takes torques for these arms.
    """
    require_target(name)
    return TORQUE_DRIVERS[driver_of(workcell)] if name == "torque" else TARGETS[name]


def missing_for(name: str, workcell: Workcell, leader: int = 0) -> tuple[str, ...]:
    """List what a cell lacks for a target, as far as this is known without a carry.

    Args:
        name: name of the target.
        workcell: the cell.
        leader: index of the position-controlled arm.

    Returns:
        One sentence per problem, with a remedy; empty if nothing is missing.

    Raises:
        SettingsError: the target is unknown.
    """
    require_target(name)
    try:
        found = target_for(name, workcell)
    except SettingsError as error:
        return (str(error),)
    checks = found.checks(workcell, name, leader)
    if found.stiffness != "gains":
        checks.append(partial(found.stated_stiffness, workcell, name))
    problems = list[str]()
    for check in checks:
        try:
            check()
        except SettingsError as error:
            problems.append(str(error))
    return (*dict.fromkeys(problems), *missing_loads(workcell))


def missing_loads(workcell: Workcell) -> list[str]:
    """Return a warning for each robot whose tool load is not stated; empty if all are."""
    return [
        f"no tool_load is given for {robot.name}: torques and tool data leave out the pad's mass"
        for robot in workcell.robots
        if robot.tool_load is None
    ]


def missing_text(name: str, workcell: Workcell) -> str:
    """Return a text for a terminal on what a cell lacks for a target.

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
    """Return for each target of `export`, by name, a text on how its bundle is run."""
    return {name: target.how_to_run for name, target in TARGETS.items()}
