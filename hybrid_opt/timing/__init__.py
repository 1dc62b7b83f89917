"""Timing of a carry that real robots can drive: limits judged, timings found and recomputed."""
