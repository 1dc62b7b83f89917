"""Timings of a carry for real robots: limits, fastest timings, and their verification."""
