"""How programs end, and what they say beside their results, in processes of their own."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from studies.__main__ import command, main, programs
from studies.program import Program, carry_out
from symbolic.errors import DualArmError
from tests.symbolic.cells import ROOT
from tests.waiting import HANGS

PROGRAMS = programs()
HEAVY = ("casadi", "coal", "matplotlib", "mujoco", "pinocchio", "pymoo", "scipy", "toppra")
HEAD = """
import logging, sys, warnings
import numpy as np
from studies.program import run_program
from symbolic.errors import DualArmError, DualArmWarning

class Ours(DualArmWarning):
    pass

def main():
"""


def ended(body: str, *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and messages of a program with this main function."""
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    text = f"{HEAD}{lines}\nsys.exit(run_program(main))\n"
    done = subprocess.run(
        [sys.executable, "-c", text, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HANGS,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


WARNS = """
for _ in range(3):
    warnings.warn("heavy\\nbox", Ours, stacklevel=2)
np.float64(1.0) / np.float64(0.0)
warnings.warn("old", DeprecationWarning)
logging.getLogger("library").warning("odd")
print("result")
return 0
"""


def test_warnings_of_ours_once_and_others_on_demand() -> None:
    assert ended(WARNS) == (0, "result\n", "warning: heavy box\n")
    code, output, messages = ended(WARNS, "--verbose")
    assert (code, output) == (0, "result\n")
    assert messages.count("heavy box") == 1
    for words in ("divide by zero", "(DeprecationWarning", "library: odd"):
        assert words in messages


@pytest.mark.parametrize(
    ("body", "code", "message"),
    [
        ("raise DualArmError('wrong')", 2, "wrong"),
        ("raise MemoryError", 2, "out of memory"),
        ("open('/nowhere/at/all')", 2, "/nowhere/at/all: "),
        ("raise KeyboardInterrupt", 130, "interrupted"),
        ("print('\\udc80'); return 0", 0, ""),
        ("print('x'); sys.stdout.flush(); raise BrokenPipeError", 0, ""),
        ("return 1", 1, ""),
    ],
)
def test_every_end_has_its_code_and_one_message(body: str, code: int, message: str) -> None:
    found, _, messages = ended(body)
    assert (found, messages.strip().startswith(message)) == (code, True)
    assert len(messages.strip().splitlines()) == bool(message)


def test_output_that_nobody_reads_is_no_error() -> None:
    text = f"{HEAD}    print('x' * 1000000)\n    return 0\n\nsys.exit(run_program(main))\n"
    command = f"'{sys.executable}' -c \"$0\" | head -c 1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command, text],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HANGS,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "x", "")


@pytest.mark.parametrize(
    "module",
    ["numpy", "hybrid_opt.campaign"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("studies", "casadi")],
)
def test_an_interrupt_during_the_start_is_no_traceback(module: str, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("nowhere = true\n")
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "studies.run", str(wrong)],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    for line in process.stderr:  # Python tells each import when it is done
        if line.split("|")[-1].strip() == module:
            break
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=HANGS)[1]
    assert "Traceback" not in said
    assert "interrupted" in said or "wrong.toml" in said
    assert process.returncode in (2, 130, -signal.SIGINT)


def test_help_imports_nothing_heavy() -> None:
    """Of any program; what it would tell of heavy modules is read from their source."""
    text = (
        "import sys\n"
        "from importlib import import_module\n"
        "from studies.__main__ import programs\n"
        "for module, _ in programs().values():\n"
        "    assert '--verbose' in import_module(module).main.parser().format_help()\n"
        "print(len(programs()), *sorted(sys.modules))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True, timeout=HANGS
    )
    count, *imported = done.stdout.split()
    assert (done.stderr, int(count)) == ("", len(PROGRAMS))
    assert set(imported).isdisjoint(HEAVY)
    assert "numpy" in imported


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_fits_a_screen_and_hides_nothing_unnamed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    module, _ = programs()[name]
    parser = import_module(module).main.parser()
    brief, whole = parser.format_help(), parser.format_whole_help()
    assert sum(1 + max(len(line) - 1, 0) // 80 for line in brief.splitlines()) <= 50
    for action in parser._actions:
        if action.help != argparse.SUPPRESS:
            first = (action.option_strings or [action.dest])[-1].removeprefix("--no-")
            assert first in whole or first.upper() in whole
            assert first in brief or first.upper() in brief


def test_the_installed_command_runs_every_program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed,) = entry_points(group="console_scripts", name="dual-arm-carry")
    assert installed.load() is command
    for name in PROGRAMS:
        monkeypatch.setattr(sys, "argv", ["dual-arm-carry", name, "--no-such-option"])
        with pytest.raises(SystemExit) as end:
            command()
        assert end.value.code == 2
        assert capsys.readouterr().err.startswith(f"dual-arm-carry {name}: ")
    monkeypatch.setattr(sys, "argv", ["dual-arm-carry", "inspect", "none.toml"])
    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith("dual-arm-carry inspect: none.toml: ")


@pytest.mark.parametrize(
    ("called", "prefix"),
    [("dual-arm-carry", "dual-arm-carry "), ("python -m studies", "python -m studies.")],
)
def test_every_program_is_listed(
    called: str, prefix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in ([], ["--help"]):
        assert main(words, called) == 0
        listed = capsys.readouterr().out.splitlines()[2:]
        assert [line.removeprefix(prefix).split()[0] for line in listed] == list(PROGRAMS)
        assert all(line.startswith(prefix) and len(line) < 140 for line in listed)
        assert all(len(line.removeprefix(prefix).split()) > 3 for line in listed)
    assert main(["rnu"], called) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"{called}: rnu ")
    assert told.endswith("run'?\n")


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("rack", ["--qick"], "'--quick'"),
        ("run", ["cell.toml", "--evaluation=5"], "'--evaluations'"),
        ("inspect", ["cell.toml", "--no-picturs"], "'--no-pictures'"),
        ("recommend", ["results", "--force", "52"], "'--force-limit'"),
        ("replay", ["file.json", "--zzzzzz"], "--zzzzzz; "),
    ],
)
def test_a_mistyped_option_gets_a_suggestion(
    name: str, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        import_module(f"studies.{name}").main(arguments)
    told = capsys.readouterr().err
    assert end.value.code == 2
    assert told.startswith(f"python -m studies.{name}: ")
    assert words in told
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize("name", ["run", "inspect"])
def test_a_problem_file_names_the_program_for_it(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = ROOT / "studies" / "problems" / "past-a-post.toml"
    assert import_module(f"studies.{name}").main([str(problem)]) == 2
    told = capsys.readouterr().err
    assert "contacts[0].xyz: " in told
    assert told.endswith(f" dual-arm-carry propose {problem}\n")


def test_a_programs_name_stands_before_its_message(capsys: pytest.CaptureFixture[str]) -> None:
    def wrong() -> int:
        raise DualArmError("wrong")

    def stopped() -> int:
        raise KeyboardInterrupt

    assert carry_out("python -m studies.run", wrong) == 2
    assert carry_out("python -m studies.run", stopped, "--resume") == 130
    assert capsys.readouterr().err == "python -m studies.run: wrong\n\n--resume\n"
    program = Program("any", None, lambda parser: None, lambda options: wrong() + options.verbose)
    assert program([], "dual-arm-carry any") == 2
    assert capsys.readouterr().err == "dual-arm-carry any: wrong\n"
    assert Program("any", None, lambda parser: None, lambda options: 7)([]) == 7
