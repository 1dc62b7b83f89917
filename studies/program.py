"""Common parts of all programs: options, exit codes, messages."""

from __future__ import annotations

import argparse
import json
import logging
import os
import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NoReturn

from studies.options import PathType, check_paths
from symbolic import safe_io
from symbolic.errors import DualArmError, DualArmWarning, OutsideError, WorkcellError
from symbolic.records.problems import suggestion

if TYPE_CHECKING:
    from symbolic.records import Workcell


class ReportError(DualArmError):
    """A report, picture or animation cannot be made."""


FAULT, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit codes: a program found a fault in what it checked; wrong input; Ctrl-C."""

VERBOSE = "--verbose"


class _Help(argparse.HelpFormatter):
    """Formatter of help texts. It adds the default of each option that does not state it, and shows
    numbers as N."""

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        if action.type is None or isinstance(action.type, PathType):
            return super()._get_default_metavar_for_optional(action)
        return "N"

    def _split_lines(self, text: str, width: int) -> list[str]:
        return wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = self._split_lines(text, width - len(indent))
        return "\n".join(f"{indent}{line}" for line in lines)

    def _get_help_string(self, action: argparse.Action) -> str:
        # Python 3.11 and 3.12 write the default of --x and --no-x themselves.
        told = (action.help or "").removesuffix(" (default: %(default)s)")
        value = action.default
        if "(default" in told or value == argparse.SUPPRESS or action.required:
            return told
        if value in (None, []):
            return f"{told} (default: none)" if action.option_strings else told
        if isinstance(value, bool):
            value = "yes" if value else "off"
        elif isinstance(value, list | tuple):
            value = " ".join(map(str, value))
        elif isinstance(value, float):
            value = f"{value:g}"
        return f"{told} (default: {value})"


class Parser(argparse.ArgumentParser):
    """Parser of a command line that reports a mistake in one line, with a suggestion."""

    def __init__(self, *, prog: str, description: str | None, further: Sequence[str] = ()) -> None:
        """Prepare a parser that accepts no abbreviated options and states defaults in `--help`.

        Args:
            prog: name of the program in the usage line.
            description: description of the program.
            further: options that `--help` only names and `--help-all` explains.
        """
        super().__init__(
            prog=prog, description=description, allow_abbrev=False, formatter_class=_Help
        )
        self._further = tuple(further)
        told = "explain every option and end" if further else argparse.SUPPRESS
        self.add_argument("--help-all", action=_HelpAll, help=told)

    def format_usage(self) -> str:
        """Return a usage line with the required arguments only; the help lists all others."""
        formatter = self._get_formatter()
        words = [
            " ".join([*action.option_strings[:1], str(action.metavar or action.dest.upper())])
            for action in self._actions
            if action.required
        ]
        formatter.add_usage(f"%(prog)s [options] {' '.join(words)}".rstrip(), (), ())
        return formatter.format_help()

    def format_help(self) -> str:
        """Return the help of the options that most users need."""
        return self._help(self._further)

    def format_whole_help(self) -> str:
        """Return the help of all options."""
        return self._help(())

    def _help(self, hidden: Sequence[str]) -> str:
        formatter = self._get_formatter()
        formatter.add_text(self.description)
        for group in self._action_groups:
            formatter.start_section(group.title)
            formatter.add_text(group.description)
            formatter.add_arguments(
                action
                for action in group._group_actions
                if not set(action.option_strings) & set(hidden)
            )
            formatter.end_section()
        if hidden:
            formatter.add_text(f"Further options, explained by --help-all: {', '.join(hidden)}")
        return f"{self.format_usage()}\n{formatter.format_help()}"

    def error(self, message: str) -> NoReturn:
        """Print the message and end the program with code 2."""
        head, _, words = message.partition("unrecognized arguments: ")
        known = self._option_string_actions if not head else ()
        meant = [
            suggestion(word.partition("=")[0], known)
            for word in words.split()
            if word.startswith("-")
        ]
        self.exit(BAD_INPUT, f"{self.prog}: {message}{''.join(meant)}; see --help\n")


class _HelpAll(argparse.Action):
    """Option that prints the help of all options."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        nothing = argparse.SUPPRESS
        super().__init__(option_strings, nothing, nargs=0, default=nothing, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        assert isinstance(parser, Parser), "only such parsers have the option"
        print(parser.format_whole_help())
        parser.exit()


class _Version(argparse.Action):
    """Option that looks up and prints the version."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        nothing = argparse.SUPPRESS
        super().__init__(option_strings, nothing, nargs=0, default=nothing, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print_version()
        parser.exit()


def print_version() -> None:
    """Print the installed version of the project."""
    from hybrid_opt import __version__

    print(f"dual-arm-carry {__version__}")


@dataclass(frozen=True)
class Program:
    """A program: `python -m studies.NAME`, or `dual-arm-carry NAME`.

    Modules for its work are imported when the work begins, so `--help` and a mistyped option are
    answered at once.

    Attributes:
        name: module name below `studies`.
        description: description of the program, for its help.
        add_options: function that adds the program's options to a parser that already has
            `--verbose`.
        run: function that does the work with the parsed options and returns the exit code; or the
            full name of such a function, which is then imported and run with libraries in one
            thread. The options also have `called`, the name by which the program was called, and
            `arguments`, the words of the command line.
        interrupted: text after Ctrl-C.
        complete: function that derives paths from other options and checks the extras that the
            options need; called before paths are checked.
        further: options that only `--help-all` explains.
    """

    name: str
    description: str | None
    add_options: Callable[[Parser], None]
    run: Callable[[argparse.Namespace], int] | str
    interrupted: str = "interrupted"
    complete: Callable[[argparse.Namespace], None] = lambda options: None
    further: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """Name of the program's module for `python -m`."""
        return f"studies.{self.name}"

    def parser(self, called: str = "") -> Parser:
        """Return the parser of the program's options.

        Args:
            called: name of the program in the usage line; '' for `python -m` and the module.
        """
        prog = called or f"python -m {self.module}"
        parser = Parser(prog=prog, description=self.description, further=self.further)
        self.add_options(parser)
        parser.add_argument("--version", action=_Version, help="print the version and end")
        parser.add_argument(
            VERBOSE,
            action="store_true",
            help="also show warnings of the libraries",
        )
        return parser

    def __call__(self, arguments: Sequence[str] | None = None, called: str = "") -> int:
        """Run the program and return its exit code.

        Args:
            arguments: words of the command line; None for those of this process.
            called: name of the command for messages; '' for the usual one.
        """
        parser = self.parser(called)
        given = list(sys.argv[1:] if arguments is None else arguments)

        def work() -> int:
            options = parser.parse_args(given)
            options.called, options.arguments = parser.prog, given
            self.complete(options)
            check_paths(parser, options)
            return _done(self.run, options) if isinstance(self.run, str) else self.run(options)

        return carry_out(parser.prog, work, self.interrupted)

    def start(self) -> NoReturn:
        """Run the program as the main program of this process, and end the process with its exit
        code."""
        sys.exit(run_program(self))


def _done(name: str, options: argparse.Namespace) -> int:
    """Call a function with the parsed options of a program, and return its exit code. Numerical
    libraries run in one thread meanwhile.

    Args:
        name: module and name of the function, such as 'studies.demo.show'.
        options: the parsed options.
    """
    from codegen.native import one_thread

    module, _, function = name.rpartition(".")
    work = getattr(import_module(module), function)
    with one_thread():
        code: int = work(options)
    return code


def load_workcell(path: Path) -> Workcell:
    """Load the workcell file that is an argument of a program.

    Raises:
        WorkcellError: the file is invalid; the message lists all problems. For a problem file it
            names the program that completes it.
    """
    from symbolic.read.cell import load

    try:
        return load(path)
    except WorkcellError as error:
        with suppress(OutsideError):
            content = safe_io.read_bytes(safe_io.resolved(path), safe_io.WORKCELL_BYTES)
            task = safe_io.toml_tables(content).get("task")
            if isinstance(task, dict) and task.keys().isdisjoint({"waypoints", "initial"}):
                raise DualArmError(
                    f"{error}\nIt has no carry yet; a workcell with one is made of such a problem "
                    f"file by: dual-arm-carry propose {shlex.quote(str(path))}"
                ) from error
        raise


def run_program(main: Callable[[], int]) -> int:
    """Run the main function of a program's process. Return the exit code.

    Each warning of this project is printed once, on one line. Warnings of libraries (divisions by
    zero, deprecations) are printed only with `--verbose`. Processes that this one starts do
    likewise.

    Args:
        main: function that does the program's work and returns the exit code.
    """
    _show_warnings(verbose=VERBOSE in sys.argv[1:])
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # names of files may hold what no terminal shows
            stream.reconfigure(errors="backslashreplace")
    try:
        code = main()
        sys.stdout.flush()
        if code == INTERRUPTED:
            _leave()
        return code
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        _leave()
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has enough; the interpreter is not to flush it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except DualArmError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except MemoryError:
        advice = "give the process more, or use smaller files or fewer --jobs"
        print(f"out of memory; {advice}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        print(f"{name}{error.strerror or error}", file=sys.stderr)
        return BAD_INPUT


def _leave() -> None:
    """End the process at once, with the exit code of an interruption, if threads are still running:
    the interpreter would wait for them. No file is left half written, because files are replaced in
    one step.
    """
    main = threading.main_thread()
    if any(not each.daemon for each in threading.enumerate() if each is not main):
        sys.stderr.flush()
        os._exit(INTERRUPTED)


def carry_out(program: str, work: Callable[[], int], interrupted: str = "interrupted") -> int:
    """Do the work of a program. If it raises an error, print one message and return the exit code
    of that error.

    Args:
        program: name of the program, in front of the message.
        work: function that does the work and returns the exit code.
        interrupted: text after Ctrl-C.
    """
    try:
        return work()
    except DualArmError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"\n{interrupted}", file=sys.stderr)
        return INTERRUPTED


def _show_warnings(verbose: bool) -> None:
    """Print every warning of this project once, and all other warnings if verbose, without a line
    of source code."""
    told: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = " ".join(str(message).split())
        if text not in told:
            told.add(text)
            where = "" if issubclass(category, DualArmWarning) else f" ({category.__name__})"
            print(f"warning: {text}{where}", file=sys.stderr)

    warnings.simplefilter("always" if verbose else "ignore")
    warnings.filterwarnings("always", category=DualArmWarning)
    warnings.showwarning = show
    if verbose:
        logging.basicConfig(format="%(name)s: %(message)s")
    else:
        os.environ["PYTHONWARNINGS"] = "ignore"
        logging.getLogger().addHandler(logging.NullHandler())


@dataclass(frozen=True)
class ProgramResult:
    """One result of a program.

    Attributes:
        values: values by name, for JSON; `dataclasses.asdict` converts records.
        lines: the same result as lines of text.
    """

    values: Mapping[str, Any]
    lines: tuple[str, ...] = ()


def print_findings(findings: Iterable[ProgramResult], as_json: bool) -> None:
    """Print the results of a program.

    Args:
        findings: the results; each is printed as soon as it exists.
        as_json: True to print all results at the end, as one JSON object.
    """
    values: dict[str, Any] = {}
    for finding in findings:
        values |= finding.values
        for line in () if as_json else finding.lines:
            print(line, flush=True)
    if as_json:
        print(json.dumps(values, default=asdict, indent=2))
