"""The benchmark's figures as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def report(result: Mapping[str, Any]) -> str:
    """All figures of `studies.benchmark.benchmark`."""
    machine, line = result["machine"], result["scaling"]["samples_line"]
    collisions = result["with_collisions"]
    rows = [
        f"{result['workcell']}: {result['samples']} samples, "
        f"{result['free_waypoints']} free waypoints",
        f"{machine['processor']}, Python {machine['python']}; one core, medians of "
        f"{result['candidates']} candidates x {result['repeats']} rounds, seed {result['seed']}",
        "",
        *_ways(result),
        "",
        f"with collisions, means over candidates of a search ({collisions['evaluations']} "
        f"evaluations, batches of {collisions['population']})",
        *_ways(collisions),
        *_shares(collisions),
        *_peak(collisions),
        "",
        "with collisions, means over random candidates",
        *_ways(collisions["random"]),
        *_shares(collisions["random"]),
        "",
        "samples      ms per candidate, one at a time",
        *(f"{e['samples']:7d}  {e['compiled_ms']:20.3f}" for e in result["scaling"]["samples"]),
        f"line: {1e3 * line['ms_per_sample']:.2f} us per sample + {1e3 * line['fixed_ms']:.1f} us, "
        f"off by at most {100 * line['largest_relative_deviation']:.0f} %",
        "",
        "waypoints    ms per candidate, one at a time",
        *(f"{e['waypoints']:7d}  {e['compiled_ms']:20.3f}" for e in result["scaling"]["waypoints"]),
    ]
    return "\n".join(rows)


def _ways(figures: Mapping[str, Any]) -> list[str]:
    return [
        "way          ms per candidate  over compiled",
        f"compiled     {figures['compiled_ms']:16.3f}  {1.0:13.1f}",
        f"interpreted  {figures['interpreted_ms']:16.3f}  "
        f"{figures['interpreted_over_compiled']:13.1f}",
        f"plain        {figures['plain_ms']:16.3f}  {figures['plain_over_compiled']:13.1f}",
    ]


def _peak(figures: Mapping[str, Any]) -> list[str]:
    rate = f"{1e-9 * figures['operations_per_second']:.1f} billion operations a second"
    if figures["share_of_peak"] is None:
        return [f"{rate}, one evaluation at a time"]
    return [
        f"{rate}, {100 * figures['share_of_peak']:.0f} % of the core's peak (counted in the CasADi "
        "functions; the peak is that of independent additions and multiplications, measured)"
    ]


def _shares(figures: Mapping[str, Any]) -> list[str]:
    parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in figures["shares"].items())
    ratio = figures.get("compiled_over_paper")
    joint = [] if ratio is None else [f"{ratio:.2f} times a candidate of the allocation paper"]
    return [*joint, f"feasible {100 * figures['feasible_share']:.0f} %; compiled time: {parts}"]
