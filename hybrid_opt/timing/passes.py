"""The compiled passes: `c/passes.c` for one workcell, as a numeric function."""

from __future__ import annotations

from importlib.resources import files

from codegen.build import load_or_compile
from codegen.cache import source_digest
from codegen.function import NumericFunction, Signature
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.records import TimingStatus
from symbolic.records import Workcell

KINDS = (
    "joint velocity",
    "payload velocity",
    "payload angular velocity",
    "path speed",
    "joint acceleration",
    "payload acceleration",
    "payload angular acceleration",
    "normal force",
    "joint torque",
    "pressure shift",
)
"""Limits as `c/passes.c` numbers them."""

OUTCOMES = (
    TimingStatus.OK,
    TimingStatus.INFEASIBLE_AT_REST,
    TimingStatus.SOLVER_FAILED,
    TimingStatus.NOT_CONVERGED,
    TimingStatus.SOLVER_FAILED,
)
"""Meanings of its statuses."""


def passes_function(
    compiled: CompiledCell, intervals: int, cuts: int = 0
) -> NumericFunction | None:
    """The timing of one path from its limits; None where these do not tell the contact wrenches.

    Inputs: samples (2 intervals + 1, `LimitLayout.size`), both ends and the middle of
    every interval; options (4,): largest normal force [N],
    infinite for none, then whether torques, pressure shifts and the reference speeds are limited
    (0 or 1); with cuts, cuts (2 intervals + 1, cuts, 3): at every sample lines
    alpha u'' + beta u'^2 <= bound that hold as well, positive bounds, infinite ones from the last
    line on. Outputs: status, index into `OUTCOMES`; interval of a failure; duration [s], infinite
    without a timing; peak (2,) normal forces [N]; use (len(KINDS), 3): largest share of each limit,
    path parameter and joint or contact there; squared (intervals + 1,) u'^2 at the grid points;
    sweeps, how often both passes ran; slowed, the factor on the speed. Without a timing peak and
    use are those of standing still.

    Args:
        compiled: the cell.
        intervals: pieces of constant path acceleration.
        cuts: lines at every sample that the caller gives.
    """
    workcell, cache = compiled.workcell, compiled.cache
    if workcell.has_opposite_pads and not workcell.has_closed_form:
        return None  # among wrenches of the same effort the load function keeps the paper's
    details = (str(intervals), str(cuts), source_digest(__name__), _passes_c())
    key = compiled.key("path timing", *details, bodies=False)
    made = load_or_compile(key, lambda: _source(compiled.symbols.workcell, intervals, cuts), cache)
    return compiled.bound(made)


def _passes_c() -> str:
    return files("hybrid_opt.timing").joinpath("c/passes.c").read_text()


def _source(workcell: Workcell, intervals: int, cuts: int) -> tuple[Signature, str]:
    # Not imported at the top: a warm start needs no CasADi.
    from codegen.source import handwritten_source
    from symbolic.expression import sx_given
    from symbolic.limits import force_functions, limit_layout, ratio_functions

    layout = limit_layout(workcell)
    helpers = (*force_functions(workcell), *ratio_functions(workcell))
    rooms = [(f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w()) for f in helpers]
    # The numbers of what is held come fourth, where a function takes them.
    most = (max(4, *sizes) for sizes in zip(*rooms, strict=True))
    constants = {
        **dict(zip(("ROOM_ARG", "ROOM_RES", "ROOM_IW", "ROOM_W"), most, strict=True)),
        "INTERVALS": intervals,
        "JOINTS": layout.joints,
        "SIZE": layout.size,
        "RATIOS": layout.joints + 2,
        "CUTS": cuts,
        "HELD": 3 if cuts else 2,
        **{f"AT_{name.upper()}": place for name, place in layout.offsets.items()},
    }
    held = sx_given(workcell.payload)
    text = "".join(
        [
            *[f"#define {name} {value}\n" for name, value in constants.items()],
            _passes_c(),
        ]
    )
    signature = Signature(
        "path_timing",
        ("samples", "options", *(("cuts",) if cuts else ()), *held),
        ("status", "interval", "duration", "peak", "use", "squared", "sweeps", "slowed"),
        (
            *((2 * intervals + 1, layout.size), (4,)),
            *(((2 * intervals + 1, cuts, 3),) if cuts else ()),
            *((int(symbols.numel()),) for symbols in held.values()),
        ),
        ((), (), (), (2,), (len(KINDS), 3), (intervals + 1,), (), ()),
    )
    return signature, handwritten_source(signature, text, helpers)
