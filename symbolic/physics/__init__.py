"""Motion and forces of the payload: path, time laws, rotation, contact forces, pressure, loads."""
