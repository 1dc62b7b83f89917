"""Readers from bytes to records: workcell files, robot descriptions, meshes.

cell: a whole workcell file. cell_files: a workcell file and all files that it names as one value.
tables, elements: typed reading of TOML and XML. descriptions, urdf, arms: a robot's description,
and the arm in it. scenes: scenes of other programs, as bodies.
"""
