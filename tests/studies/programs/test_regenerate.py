"""`python -m studies.regenerate` on a tiny cell: what it prints, what it refuses, how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence

from codegen.cache import Cache
from tests.waiting import HANGS

# The command with a cell of one function in place of the workcell's file and evaluators.
PROGRAM = """
import sys, types
import casadi as ca, numpy as np
from symbolic.errors import WorkcellError

def load(path):
    if path.name != "cell.toml":
        raise WorkcellError(str(path), ("file: missing; name a workcell",))
    task = types.SimpleNamespace(
        lower=np.full(3, 2.0), upper=np.full(3, 5.0), time_law="constant"
    )
    return types.SimpleNamespace(digest="tiny", task=task)

def arm_functions(model):
    x, p = ca.MX.sym("x", 3), ca.MX.sym("p", 2, 2)
    # NaN outside the bounds of x.
    return {"roots": ca.Function("roots", [x, p], [ca.sqrt(x - 2), p @ p], ["x", "p"], ["y", "z"])}

class CompiledCell:
    EVALUATORS, SCREENING, EVALUATOR_LANES = "evaluators", "screening", 0
    symbols = types.SimpleNamespace(screening={})

    def __init__(self, workcell, cache):
        pass

    def key(self, name, bodies=True):
        return f"{name} of a tiny cell"

    def vector(self, name):
        return np.zeros(0)

compiled = {"CompiledCell": CompiledCell, **vars(CompiledCell)}
faked = {
    "symbolic.functions": {"arm_functions": arm_functions},
    "symbolic.read.cell": {"load": load},
    "hybrid_opt.compiled_cell": compiled,
}
for name, content in faked.items():
    sys.modules[name] = types.ModuleType(name)
    for key in content:
        if not key.startswith("__"):
            setattr(sys.modules[name], key, content[key])
EDIT
from studies.regenerate import main
sys.exit(main(sys.argv[1:]))
"""


def run(arguments: Sequence[str], edit: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("EDIT", edit), *arguments],
        env=os.environ | {"COLUMNS": "100"},
        capture_output=True,
        text=True,
        timeout=HANGS,
        check=False,
    )


def test_table(cache: Cache) -> None:
    first, second = run(["cell.toml"]), run(["cell.toml"])
    assert first.returncode == second.returncode == 0
    headings, rule, row = first.stdout.splitlines()
    for heading in ("function", "operations", "C size", "compile time", "from cache"):
        assert heading in headings
    assert set(rule) == {"-"}
    assert row.startswith("roots")
    assert row.endswith(" no")
    assert "kB" in row
    assert second.stdout.splitlines()[2].endswith(" yes")


def test_json_and_check(cache: Cache) -> None:
    done = run(["cell.toml", "--check", "--json", "--samples", "5"])
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["cache"] == str(cache.folder)
    (function,) = result["functions"]
    assert function["name"] == "roots"
    assert function["operations"] > 0
    assert function["c_bytes"] > 0
    assert function["compile_seconds"] > 0.0
    assert function["from_cache"] is False
    (check,) = result["check"]
    assert check["agrees"] is True
    assert check["samples"] == 5
    assert check["outputs"] <= 1e-10
    assert check["derivatives"] <= 1e-10


def test_check_compiles_anew(cache: Cache) -> None:
    run(["cell.toml"])
    done = run(["cell.toml", "--check", "--json"])
    assert json.loads(done.stdout)["functions"][0]["from_cache"] is False


def test_check_finds_a_difference(cache: Cache) -> None:
    """A compiler that rounds differently by one part in 1e9 is caught, with the output's name."""
    edit = """
import re
import codegen.source as source
plain = source.c_source
rounded = lambda text: re.sub(r"\\bsqrt\\(", "1.000000001 * sqrt(", text)
source.c_source = lambda f, *more: rounded(plain(f, *more))
"""
    done = run(["cell.toml", "--check"], edit)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "NO: " in done.stdout


def test_what_the_cache_holds_is_said(cache: Cache) -> None:
    cache.write_record("0" * 64, {"kept": True})
    done = run(["--cache", "--json"])
    size = (cache.folder / f"{'0' * 64}.json").stat().st_size
    assert json.loads(done.stdout)["usage"] == {"libraries": 0, "files": 1, "size": size}


def test_clean(cache: Cache) -> None:
    run(["cell.toml"])
    assert list(cache.folder.glob("*.so"))
    done = run(["--clean"])
    assert done.returncode == 0
    assert done.stdout == f"1 libraries removed from {cache.folder}\n"
    assert list(cache.folder.iterdir()) == []
    again = run(["cell.toml", "--clean", "--json"])
    assert json.loads(again.stdout)["removed"] == 0


def test_bad_input_is_one_message_and_code_2(cache: Cache) -> None:
    missing = run(["other.toml"])
    assert missing.returncode == 2
    assert missing.stdout == ""
    assert "file: missing; name a workcell" in missing.stderr
    assert "Traceback" not in missing.stderr
    cache.folder.mkdir()
    cache.folder.chmod(0o777)
    unsafe = run(["cell.toml"])
    assert unsafe.returncode == 2
    assert len(unsafe.stderr.splitlines()) == 1
    assert "others can write to it" in unsafe.stderr


def test_wrong_options_are_told(cache: Cache) -> None:
    for arguments, message in (
        ([], "name a workcell file, --cache or --clean"),
        (["cell.toml", "--samples", "0"], "--samples: found '0'; allowed is a whole number 1 to"),
        (["cell.toml", "--seed", "-1"], "--seed: found '-1'; allowed is a whole number 0 to"),
    ):
        done = run(arguments)
        assert done.returncode == 2
        assert message in done.stderr


def test_without_a_compiler_nothing_is_begun(cache: Cache) -> None:
    done = run(["cell.toml"], "import os; os.environ['CC'] = '/missing/cc'")
    assert done.returncode == 2
    assert "no C compiler that works was found (CC names '/missing/cc')" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not cache.folder.exists()
