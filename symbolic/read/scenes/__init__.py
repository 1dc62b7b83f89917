"""Scenes of other programs to bodies of a cell's environment: SDF, MoveIt, MJCF."""
