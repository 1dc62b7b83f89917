"""What every program that runs a job does, however it reaches the arms: options, Ctrl-C, the words
'continue', 'back' and 'leave', and the order of checks, measurements and the job itself."""

from __future__ import annotations

import signal
from abc import ABC, abstractmethod
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybrid_opt.extras.bundles.programs.bring_up import (
    AIR,
    BACK,
    BLOCK,
    FILE,
    Looks,
    Measured,
    bring_up,
    require,
    unloaded,
)
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Seen


def options_of(description: str | None, arguments: Sequence[str] | None) -> Namespace:
    """Read the options of a program from its command line: --check, --in-air or --bring-up.

    Args:
        description: description of the program in its help.
        arguments: arguments of the command line; None for those of this process.
    """
    parser = ArgumentParser(description=description)
    group = parser.add_mutually_exclusive_group()
    for name, text in (
        ("--check", "look at both arms and move nothing"),
        ("--in-air", "drive the whole job without a box and without force"),
        ("--bring-up", "measure both arms and write " + FILE),
    ):
        group.add_argument(name, action="store_true", help=text)
    return parser.parse_args(arguments)


class JobRun(ABC):
    """A job that both arms run. Subclasses reach the arms' controllers.

    Attributes:
        job, machine: the job that is run, and its state machine.
        looks: store of measurements while the arms are measured, else None.
        signs: for each arm, the sign of its sensor's reading when the pad presses; None while the
            arms are measured.
        fault: reason why the job has to stop, '' for none.
        lost: True if an arm does not follow its commands.
        command: last word that somebody has said.
        log: where messages go, with the methods `info` and `error`.
    """

    job: Job
    machine: Machine

    def __init__(self, known: Sequence[Measured] | Looks, log: Any) -> None:
        """Begin without a job. `known` holds the measured properties of both arms, or is a store of
        measurements if the arms are to be measured.
        """
        self.looks = known if isinstance(known, Looks) else None
        self.signs = None if isinstance(known, Looks) else [each.sign for each in known]
        self.fault, self.lost, self.command, self.log = "", False, "", log

    @abstractmethod
    def take(self, job: Job) -> None:
        """Store the job that is to run next, and begin at its start."""

    @abstractmethod
    def seen(self) -> Seen:
        """Return the measured state of the arms now."""

    @abstractmethod
    def cycle(self) -> None:
        """Handle messages for a short time; advance or stop a job that has begun."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the controllers ready, once before the arms move."""

    def check(self) -> None:
        """Raise a `Refused` if an arm is not ready for the job."""
        self.machine.check(self.seen())

    def start(self) -> None:
        """Start the job, or raise a `Refused` if the arms are not ready."""
        self.machine.start(self.seen())

    @abstractmethod
    def go_on(self, direction: float) -> None:
        """Send the commands of a job that continues.

        Args:
            direction: 1 forward, -1 back.
        """

    def status(self) -> str:
        """Return a text that says in which state the job is."""
        return self.machine.status()

    def fail(self, reason: str, lost: bool = False) -> None:
        """Request a stop. If several are requested, the first reason is kept.

        Args:
            reason: reason of the stop.
            lost: True if an arm does not follow its commands.
        """
        self.fault, self.lost = self.fault or reason, self.lost or lost

    def interrupt(self, *_: object) -> None:
        """Stop the job on Ctrl-C; if the job already holds, end the program."""
        if self.machine.state == "held":
            self.command = "leave"
        self.fail("Ctrl-C")

    def hold(self, error: Refused) -> None:
        """Hold the arms where they are commanded to be, because the job cannot continue."""
        self.machine.hold(str(error))
        self.log.error(self.status())

    def obey(self) -> None:
        """Continue a held job if the operator's last word is 'continue' (forward) or 'back'."""
        if self.machine.state == "held" and self.command in ("continue", "back"):
            direction = 1.0 if self.command == "continue" else -1.0
            self.command, self.fault, self.lost = "", "", False
            try:
                self.machine.resume(direction, self.seen())
            except Refused as error:
                self.hold(error)
            else:
                self.go_on(direction)

    def drive(self, part: Job, word: str) -> bool:
        """Run a job to its end and back.

        Args:
            part: the job, or a part of it.
            word: word that the operator has to enter before the arms move; '' to begin without one.

        Returns:
            True if the arms are back at the beginning.
        """
        self.take(part)
        self.log.info(BLOCK if word else AIR)
        while self.command != word and not self.fault:
            self.cycle()
        self.check()
        self.start()
        if self.look_after():
            return False
        self.machine.hold("it goes back")
        self.command = "back"
        self.obey()
        return self.look_after() == BACK

    def look_after(self) -> int:
        """Supervise the started job until it ends.

        Returns:
            0 if the job is done, `BACK` if the arms are back at its beginning, 1 if the operator
            has left while the job was held.
        """
        while self.machine.state != "done":
            self.cycle()
            if self.machine.state == "held" and self.command == "leave":
                self.log.error(f"left while {self.status()}")
                return 1
        return 0 if self.machine.clock.s > 0.0 else BACK


def run(
    options: Namespace, folder: Path, config: dict[str, Any], make: Callable[..., JobRun], log: Any
) -> int:
    """Run the job of a bundle, or measure its arms.

    Args:
        options: options of the program, from `options_of`.
        folder: folder of the bundle.
        config: settings of the bundle, of which `plan` is read.
        make: class or function that makes the run from the job, the settings, the measured
            properties of both arms (or a store of measurements), and `log`.
        log: logger with the methods `info` and `error`.

    Returns:
        Exit code of the program: 0 when the job is done, 2 if it was refused, else as in
        `JobRun.look_after`.
    """
    looks, plan = Looks(), config["plan"]
    try:
        job = Job.read(folder / "job.json")
        is_free = options.check or options.in_air or options.bring_up
        arms = make(job, config, looks if is_free else require(folder, job, plan), log)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, arms.interrupt)
        if options.check:
            arms.check()
            log.info("both arms are at their first positions")
            return 0
        arms.prepare()
        if options.bring_up:
            return bring_up(folder, job, plan, arms.drive, looks)
        if options.in_air:
            arms.take(unloaded(job))
        arms.check()
        arms.start()
        return arms.look_after()
    except (OSError, Refused) as error:
        log.error(str(error))
        return 2
