"""How both arms of a bundle start together, and the skew that a job has to survive for it."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.store.export.options import BundleOptions

SKEW = 0.01
"""Largest start skew expected of two controllers with clocks of their own [s]."""


@dataclass(frozen=True)
class Start:
    """How a form starts both arms.

    Attributes:
        how: in words.
        skew: between both arms that the job has to survive [s]; None where nobody asks.
    """

    how: str
    skew: float | None


_FORMS = {
    "ros2": Start("one controller drives all joints: both arms start in the same cycle", 0.0),
    "rapid": Start("synchronised moves of one MultiMove controller", 0.0),
    "urscript": Start(
        "both programs meet before each phase over a digital line each way: what remains is a "
        "cycle and the lines' latency",
        SKEW,
    ),
}
_TWO_CONTROLLERS = Start(
    "the goals of both controllers bear one start time: what remains is the difference of their "
    "machines' clocks",
    SKEW,
)
_DATA = Start("up to what plays the file", None)


def start_of(form: str, options: BundleOptions) -> Start:
    """How a bundle starts both arms; the skew is the one that is asked for, where one is."""
    two = form == "ros2" and options.per_arm
    found = _TWO_CONTROLLERS if two else _FORMS.get(form, _DATA)
    return found if options.skew is None else Start(found.how, options.skew)
