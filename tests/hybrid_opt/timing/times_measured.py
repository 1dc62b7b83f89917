"""What timing one path costs on one core, in the process's own time.

    python -m tests.hybrid_opt.timing.times_measured

times the hand-made path of the tests' small cell by the compiled passes and by `time_path`, also
where torques rule. docs/timing.md says what these have to reach.
"""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.path_timer import PATH_INTERVALS, PathTimer
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from tests.hybrid_opt.timing.cells import hand_timing, initial, timing_of, with_robots
from tests.symbolic.cells import hand_cell, hand_model

ROUNDS = 10
LIMITS = TimingLimits(force=1.1 * 98.1 / 2.0)


def milliseconds(call: Callable[[], object]) -> float:
    """Of one call."""
    begin = process_time()
    call()
    return 1e3 * (process_time() - begin)


def main() -> None:
    cell, model = hand_cell(), hand_timing(PATH_INTERVALS)
    timer = PathTimer(CompiledCell(cell, model=hand_model(cell)), lanes=1)
    weak = timing_of(with_robots(hand_cell(), torque_max=0.6))
    calls: dict[str, Callable[[], object]] = {
        "compiled passes": lambda: timer.time(initial(), LIMITS),
        "time_path": lambda: time_path(model, initial(), LIMITS),
        "time_path, torques rule": lambda: time_path(weak, initial()),
    }
    least = {name: min(milliseconds(call) for _ in range(ROUNDS)) for name, call in calls.items()}
    for name, cost in least.items():
        print(f"{name}: {cost:.2f} ms")
    ratio = least["time_path"] / least["compiled passes"]
    print(f"the passes take one {ratio:.0f}th of time_path")


if __name__ == "__main__":
    main()
