"""Faults of the machine, with the real thing: killed processes, full disks, bad compilers."""
