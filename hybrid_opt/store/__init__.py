"""Files: trajectories, exports, atomic writes."""
